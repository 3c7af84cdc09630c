"""Loop that connects to the configured brokers in turn, whose MQTT version is unknown, until it is closed."""

import asyncio
import contextlib
import itertools
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from typing import Any

import aiomqtt
import structlog
from aiomqtt import ProtocolVersion

from bms_estimator.model.errors import UserError
from bms_estimator.mqtt.client import (
    DEFAULT_TIMEOUTS,
    Client,
    Timeouts,
    failure_reason,
    is_login_error,
    open_client,
    should_retry_with_v311,
)
from bms_estimator.mqtt.connection import (
    Broker,
    BrokerConnectionError,
    Connect,
    Connection,
    ConnectOptions,
    DeliveryStats,
    LoginError,
    password,
    tls_context,
)
from bms_estimator.process.runtime import FIRST_DELAY_S, MAX_DELAY_S, Backoff
from bms_estimator.settings.connections import BrokerSettings


class BrokerConnector:
    """Connects by MQTT 5, or by MQTT 3.1.1 if the broker rejects MQTT 5 or does not respond.

    Args:
        settings: User name, password and certificates. The files are reloaded for each connection.
        timeouts: Timeouts of the connection.
    """

    def __init__(self, settings: BrokerSettings, timeouts: Timeouts = DEFAULT_TIMEOUTS) -> None:
        self._settings, self._timeouts = settings, timeouts
        # URLs to try with MQTT 3.1.1 next: the broker rejected MQTT 5, or did not respond, as very old brokers do
        self._v311_urls: set[str] = set()

    @contextlib.asynccontextmanager
    async def __call__(self, broker: Broker, options: ConnectOptions) -> AsyncIterator[Client]:
        """Connect as ``Connect`` specifies.

        Raises:
            BrokerConnectionError: The broker cannot be reached, or refuses.
        """
        async with contextlib.AsyncExitStack() as stack:
            try:
                client = await self._connect(
                    stack, await asyncio.to_thread(self._arguments, broker), broker.url, options
                )
            except UserError as error:
                raise BrokerConnectionError(str(error)) from None
            except aiomqtt.MqttError as error:
                kind = LoginError if is_login_error(error) else BrokerConnectionError
                raise kind(failure_reason(error, self._settings.section)) from None
            yield client

    async def _connect(
        self, stack: contextlib.AsyncExitStack, arguments: dict[str, Any], url: str, options: ConnectOptions
    ) -> Client:
        protocol = ProtocolVersion.V311 if url in self._v311_urls else ProtocolVersion.V5
        try:
            async with asyncio.timeout(self._timeouts.connect_s):
                try:
                    return await stack.enter_async_context(
                        open_client(arguments, protocol, options, self._timeouts, self._settings.section)
                    )
                except aiomqtt.MqttError as error:
                    if protocol is ProtocolVersion.V311 or not should_retry_with_v311(error):
                        raise
                client = await stack.enter_async_context(
                    open_client(arguments, ProtocolVersion.V311, options, self._timeouts, self._settings.section)
                )
                self._v311_urls.add(url)  # saves the rejected attempt and its TLS handshake next time
                return client
        except TimeoutError:
            self._v311_urls ^= {url}  # try the other version next time
            raise BrokerConnectionError(f"no answer within {self._timeouts.connect_s:g} s") from None

    def _arguments(self, broker: Broker) -> dict[str, Any]:
        """Return the arguments for aiomqtt; reads files.

        Raises:
            UserError: A file cannot be used.
        """
        return {
            "hostname": broker.host,
            "port": broker.port,
            "username": self._settings.username,
            "password": password(self._settings),
            "tls_context": tls_context(self._settings) if broker.tls else None,
        }


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
