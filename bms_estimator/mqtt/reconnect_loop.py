"""Loop that connects to the configured brokers in turn until it is closed."""

import asyncio
import itertools
from collections.abc import Awaitable, Callable, Sequence

import structlog

from bms_estimator.mqtt.broker_config import Broker
from bms_estimator.mqtt.connection import BrokerConnectionError, Connect, Connection, ConnectOptions
from bms_estimator.mqtt.delivery_stats import DeliveryStats
from bms_estimator.process.tasks import FIRST_DELAY_S, MAX_DELAY_S, Backoff

MIN_CONNECTION_S = 10.0
"""Minimum duration of a connection that counts as successful [s]; a shorter one is followed by the backoff delay."""
LOG_S = 600.0
"""Minimum interval between two log lines with an unchanged reason [s]."""

log = structlog.get_logger(__name__)


class ReconnectLoop:
    """Connects, serves the connection, and reconnects until it is closed.

    After a failure the next broker is tried without delay. After the last one there is a backoff delay.

    Args:
        brokers: Brokers in the order of attempts.
        options: Connect options.
        connect: Opens a connection.
        serve: Uses a connection until it is lost or the loop is closed.
        delivery: Statistics in which losses and their reasons are recorded.
        first_delay_s: First backoff delay [s].
        max_delay_s: Maximum backoff delay [s].

    Attributes:
        closing: Event that ends the loop.
    """

    def __init__(
        self,
        brokers: Sequence[Broker],
        options: ConnectOptions,
        connect: Connect,
        serve: Callable[[Connection], Awaitable[None]],
        delivery: DeliveryStats,
        first_delay_s: float = FIRST_DELAY_S,
        max_delay_s: float = MAX_DELAY_S,
    ) -> None:
        self._brokers, self._options, self._connect, self._serve = brokers, options, connect, serve
        self._delivery = delivery
        self._backoff = Backoff(first_delay_s, max_delay_s)
        self._logged: dict[str, tuple[str, float]] = {}  # by URL: last reason and the time at which it was logged
        self.closing = asyncio.Event()

    async def run(self) -> None:
        """Stay connected until ``closing`` is set."""
        failed_attempts = 0
        for broker in itertools.cycle(self._brokers):
            if self.closing.is_set():
                return
            if await self._attempt(broker):
                failed_attempts = 0
                self._backoff.reset()
            failed_attempts += 1  # also after a successful connection, which is lost now
            if failed_attempts % len(self._brokers) == 0:
                await self._pause(self._backoff.next_s())

    async def _attempt(self, broker: Broker) -> bool:
        """Connect to one broker and serve. Return True if the connection lasted ``MIN_CONNECTION_S``."""
        loop = asyncio.get_running_loop()
        connected_at_s: float | None = None
        try:
            async with self._connect(broker, self._options) as connection:
                connected_at_s = loop.time()
                log.info("broker connected", url=broker.url, protocol=connection.protocol)
                self._logged.clear()
                self._delivery.trouble = None
                await self._serve(connection)
        except* BrokerConnectionError as errors:
            self._delivery.losses += connected_at_s is not None
            self._log_loss(broker, "broker not reachable" if connected_at_s is None else "broker lost", errors)
        return connected_at_s is not None and loop.time() - connected_at_s >= MIN_CONNECTION_S

    def _log_loss(self, broker: Broker, event: str, errors: BaseException) -> None:
        """Log a changed reason at once, and an unchanged reason every ``LOG_S``: a broker may be absent for days."""
        while isinstance(errors, BaseExceptionGroup):
            errors = errors.exceptions[0]
        reason, now_s = str(errors), asyncio.get_running_loop().time()
        self._delivery.trouble = reason
        logged_reason, logged_s = self._logged.get(broker.url, ("", 0.0))
        if reason != logged_reason or now_s - logged_s >= LOG_S:
            self._logged[broker.url] = reason, now_s
            log.warning(event, url=broker.url, reason=reason)

    async def _pause(self, delay_s: float) -> None:
        """Sleep until the delay is over or the loop is closed."""
        try:
            async with asyncio.timeout(delay_s):
                await self.closing.wait()
        except TimeoutError:
            return
