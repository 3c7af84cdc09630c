"""Connection to a broker whose MQTT version is unknown."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Any

import aiomqtt
from aiomqtt import ProtocolVersion

from bms_estimator.model.errors import UserError
from bms_estimator.mqtt.broker_config import Broker, password, tls_context
from bms_estimator.mqtt.client import PATIENCE, Client, Timeouts, connected, refusal, should_retry_with_v311
from bms_estimator.mqtt.connection import BrokerConnectionError, ConnectOptions
from bms_estimator.settings.mqtt import MqttSettings


class BrokerConnector:
    """Connects by MQTT 5; by 3.1.1 if the broker rejects that or does not respond.

    Args:
        settings: Name, password and certificates. The files are reloaded for each connection.
        patience: Timeouts of the connection.
    """

    def __init__(self, settings: MqttSettings, patience: Timeouts = PATIENCE) -> None:
        self._settings, self._patience = settings, patience
        self._silent: set[str] = set()  # gave no answer at all to MQTT 5, as a stopped broker does, and a very old one

    @contextlib.asynccontextmanager
    async def __call__(self, broker: Broker, hello: ConnectOptions) -> AsyncIterator[Client]:
        """Connect as ``Connect`` specifies.

        Raises:
            BrokerConnectionError: The broker cannot be reached, or refuses.
        """
        async with contextlib.AsyncExitStack() as stack:
            try:
                client = await self._connect(stack, await asyncio.to_thread(self._arguments, broker), broker.url, hello)
            except UserError as error:
                raise BrokerConnectionError(str(error)) from None
            except aiomqtt.MqttError as error:
                raise BrokerConnectionError(refusal(error)) from None
            yield client

    async def _connect(
        self, stack: contextlib.AsyncExitStack, arguments: dict[str, Any], url: str, hello: ConnectOptions
    ) -> Client:
        protocol = ProtocolVersion.V311 if url in self._silent else ProtocolVersion.V5
        try:
            async with asyncio.timeout(self._patience.connected_s):
                try:
                    return await stack.enter_async_context(connected(arguments, protocol, hello, self._patience))
                except aiomqtt.MqttError as error:
                    if protocol is ProtocolVersion.V311 or not should_retry_with_v311(error):
                        raise
                return await stack.enter_async_context(
                    connected(arguments, ProtocolVersion.V311, hello, self._patience)
                )
        except TimeoutError:
            self._silent ^= {url}  # the other version next time
            raise BrokerConnectionError(f"no answer within {self._patience.connected_s:g} s") from None

    def _arguments(self, broker: Broker) -> dict[str, Any]:
        """Return the arguments for aiomqtt; reads files.

        Raises:
            UserError: One of them cannot be used.
        """
        return {
            "hostname": broker.host,
            "port": broker.port,
            "username": self._settings.username,
            "password": password(self._settings),
            "tls_context": tls_context(self._settings) if broker.tls else None,
        }
