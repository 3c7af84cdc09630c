"""Staying connected: one broker after the other, for as long as it takes."""

import asyncio
import itertools
from collections.abc import Awaitable, Callable, Sequence

import structlog

from bms_estimator.mqtt.broker_config import Broker
from bms_estimator.mqtt.connection import BrokerConnectionError, Connect, Connection, ConnectOptions
from bms_estimator.mqtt.delivery_stats import DeliveryStats
from bms_estimator.process.backoff import FIRST_DELAY_S, Backoff

MIN_CONNECTION_S = 10.0
"""A connection that ends sooner is taken as an attempt that failed [s]."""
LOG_S = 600.0
"""Minimum interval between two log lines with equal reason [s]."""

log = structlog.get_logger(__name__)


class ReconnectLoop:
    """Connects, serves, and connects again until it is closed.

    The next broker is tried at once. When all were tried there is a pause.

    Args:
        brokers: In the order in which they are tried.
        hello: Connect options.
        connect: Makes a connection.
        serve: Uses it until it is lost or the link is closed.
        delivery: What went wrong is noted there.
        first_delay_s: The first pause [s].
    """

    def __init__(
        self,
        brokers: Sequence[Broker],
        hello: ConnectOptions,
        connect: Connect,
        serve: Callable[[Connection], Awaitable[None]],
        delivery: DeliveryStats,
        first_delay_s: float = FIRST_DELAY_S,
    ) -> None:
        self._brokers, self._hello, self._connect, self._serve = brokers, hello, connect, serve
        self._delivery = delivery
        self._pauses = Backoff(first_delay_s)
        self._said: dict[str, tuple[str, float]] = {}  # by URL: the last reason and when it was logged
        self.closing = asyncio.Event()

    async def run(self) -> None:
        """Stay connected until ``closing``."""
        tried = 0
        for broker in itertools.cycle(self._brokers):
            if self.closing.is_set():
                return
            if await self._attempt(broker):
                tried = 0
                self._pauses.reset()
            tried += 1
            if tried % len(self._brokers) == 0:
                await self._pause(self._pauses.next_s())

    async def _attempt(self, broker: Broker) -> bool:
        """One broker; True when it was worth the name of a connection."""
        loop = asyncio.get_running_loop()
        since_s: float | None = None
        try:
            async with self._connect(broker, self._hello) as connection:
                since_s = loop.time()
                log.info("broker connected", url=broker.url, protocol=connection.protocol)
                self._said.clear()
                await self._serve(connection)
        except* BrokerConnectionError as errors:
            self._delivery.losses += since_s is not None
            self._log_loss(broker, "broker not reachable" if since_s is None else "broker lost", errors)
        return since_s is not None and loop.time() - since_s >= MIN_CONNECTION_S

    def _log_loss(self, broker: Broker, event: str, errors: BaseException) -> None:
        """Log why; an absent broker would give the same line each half minute for days."""
        while isinstance(errors, BaseExceptionGroup):
            errors = errors.exceptions[0]
        reason, now_s = str(errors), asyncio.get_running_loop().time()
        self._delivery.trouble = reason
        said, at_s = self._said.get(broker.url, ("", 0.0))
        if reason != said or now_s - at_s >= LOG_S:
            self._said[broker.url] = reason, now_s
            log.warning(event, url=broker.url, reason=reason)

    async def _pause(self, delay_s: float) -> None:
        """Sleep, but not through the end."""
        try:
            async with asyncio.timeout(delay_s):
                await self.closing.wait()
        except TimeoutError:
            return
