"""Connection to a broker whose MQTT version is unknown."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Any

import aiomqtt
from aiomqtt import ProtocolVersion

from bms_estimator.model.errors import UserError
from bms_estimator.mqtt.broker_config import Broker, password, tls_context
from bms_estimator.mqtt.client import (
    DEFAULT_TIMEOUTS,
    Client,
    Timeouts,
    failure_reason,
    is_login_error,
    open_client,
    should_retry_with_v311,
)
from bms_estimator.mqtt.connection import BrokerConnectionError, ConnectOptions, LoginError
from bms_estimator.settings.broker import BrokerSettings


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
