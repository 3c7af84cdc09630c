"""The real connection: aiomqtt and paho, with their errors in plain words."""

import asyncio
import contextlib
import logging
import socket
from collections.abc import AsyncIterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import aiomqtt
import structlog
from aiomqtt import ProtocolVersion
from paho.mqtt.client import DisconnectFlags, error_string
from paho.mqtt.enums import MQTTErrorCode
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode
from paho.mqtt.subscribeoptions import SubscribeOptions

from bms_estimator.mqtt.connection import BrokerConnectionError, ConnectOptions, PublishRejection, ReceivedMessage
from bms_estimator.mqtt.message import Message
from bms_estimator.mqtt.reason_codes import UNSUPPORTED_VERSION, is_final, words
from bms_estimator.mqtt.receive_queue import ReceiveQueue

PARTING_S = 1.0
"""A connection that broke cannot be ended in good order [s]."""
NO_DELAY = (socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
"""Small messages go at once."""
HEAD_BYTES = 16
"""Maximum overhead of a published message beside topic and payload [bytes]."""
SOCKET_BROKE = "failed to receive on socket: "
"""Beginning of paho's log line about a socket error."""
TLS_ALERT = "[SSL: "
"""Beginning of the text of a TLS error that has a name, such as an alert sent by the broker."""

log = structlog.get_logger(__name__)


class _ToLog(logging.Handler):
    """Forward log lines of paho and aiomqtt; skip the cause of a broken socket, which the reconnect loop reports."""

    def emit(self, record: logging.LogRecord) -> None:
        said = record.getMessage()
        if not said.startswith(SOCKET_BROKE):
            log.warning("mqtt client", said=said)


_logger = logging.getLogger(__name__)
_logger.setLevel(logging.WARNING)
_logger.propagate = False
_logger.addHandler(_ToLog())


class Timeouts(NamedTuple):
    """Timeouts of a connection."""

    connected_s: float = 10.0
    """Timeout of name resolution, TCP, TLS and the broker's CONNACK together [s]."""
    keepalive_s: int = 10
    """MQTT keepalive interval [s]. The broker has as long again to answer a ping. It publishes the will of a silently
    lost client after 1.5 intervals."""
    acknowledged_s: float = 15.0
    """A broker that lives but takes longer for a message is lost; NATS takes 10 s to find a new leader [s]."""


PATIENCE = Timeouts()


class ClosedError(aiomqtt.MqttError):
    """The broker has closed the connection in place of an answer to CONNECT."""


class Client(aiomqtt.Client):
    """A connection of one version of MQTT.

    Args:
        arguments: Address, name, password and TLS for aiomqtt.
        protocol: MQTT version.
        hello: Connect options.
        patience: When it is taken as lost.
    """

    def __init__(
        self, arguments: dict[str, Any], protocol: ProtocolVersion, hello: ConnectOptions, patience: Timeouts
    ) -> None:
        limit = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]  # paho has no types there
        limit.MaximumPacketSize = hello.most_bytes
        self._is_5 = protocol is ProtocolVersion.V5
        super().__init__(
            **arguments,
            protocol=protocol,
            properties=limit if self._is_5 else None,
            identifier=hello.identifier,
            will=aiomqtt.Will(*hello.will) if hello.will else None,
            keepalive=patience.keepalive_s,
            max_queued_incoming_messages=hello.most_waiting,
            queue_type=partial(ReceiveQueue, hello.on_message_lost, hello.most_bytes),  # type: ignore[arg-type]  # it is only called
            socket_options=[NO_DELAY],
            logger=_logger,
        )
        self._acknowledged_s = patience.acknowledged_s
        self._client.on_log = self._on_log
        self.protocol = "MQTT 5" if self._is_5 else "MQTT 3.1.1"
        self._answers: dict[int, asyncio.Future[PublishRejection | None]] = {}
        self._in_flight = asyncio.Semaphore(self._client.max_inflight_messages)
        self._most_bytes: int | None = None
        self._abandoned = False
        self._why = "the connection broke"

    async def publish(self, message: Message) -> PublishRejection | None:  # type: ignore[override]
        """Publish as ``Connection`` specifies."""
        if self._most_bytes is not None and HEAD_BYTES + len(message.topic) + len(message.payload) > self._most_bytes:
            # it would end the connection
            return PublishRejection(
                f"longer than the {self._most_bytes} bytes that the broker takes", is_retryable=False
            )
        async with self._in_flight:
            info = self._client.publish(*message)
            if info.rc != MQTTErrorCode.MQTT_ERR_SUCCESS:
                raise BrokerConnectionError(f"a message cannot be sent: {error_string(info.rc)}")
            answer: asyncio.Future[PublishRejection | None] = asyncio.get_running_loop().create_future()
            self._answers[info.mid] = answer
            try:
                await asyncio.wait([answer], timeout=self._acknowledged_s)
                if (
                    not answer.done()
                ):  # it may have arrived in time: both events occurred while the process was suspended
                    raise BrokerConnectionError(
                        f"the broker has not acknowledged a message for {self._acknowledged_s:g} s"
                    )
                return answer.result()
            finally:
                self._answers.pop(info.mid, None)

    async def subscribe(self, requests: str | None, others: Sequence[str]) -> dict[str, str]:  # type: ignore[override]
        """Subscribe as ``Connection`` specifies."""
        topics = [*([requests] if requests else []), *others]
        if self._is_5:
            wanted: Any = [(topic, SubscribeOptions(qos=0, retainAsPublished=topic == requests)) for topic in topics]
        else:
            wanted = [(topic, 0) for topic in topics]
        try:
            answers = await super().subscribe(wanted)
        except aiomqtt.MqttError as error:
            raise BrokerConnectionError(f"no subscription: {error}") from None
        return {
            topic: words(answer)
            for topic, answer in zip(topics, answers, strict=False)
            if isinstance(answer, ReasonCode) and answer.is_failure
        }

    async def receive(self) -> ReceivedMessage:
        """Receive as ``Connection`` specifies."""
        try:
            message = await anext(self.messages)
        except aiomqtt.MqttError:
            raise BrokerConnectionError(self._why) from None
        return ReceivedMessage(message.topic.value, bytes(message.payload), bool(message.retain))

    def abandon(self) -> None:
        """Give up an attempt to connect, though the broker may still answer."""
        self._abandoned = True
        self._client.disconnect()

    def drop_connection(self) -> None:
        """Close the connection without DISCONNECT, so that the broker publishes the will."""
        line: Any = self._client.socket()  # of a protocol of paho's, which leaves out what all sockets have
        if line is not None:
            with contextlib.suppress(OSError):
                line.shutdown(socket.SHUT_RDWR)

    async def end_session(self) -> None:
        """End the connection, in good order where that is possible."""
        with contextlib.suppress(TimeoutError, aiomqtt.MqttError):
            async with asyncio.timeout(PARTING_S):
                await self.__aexit__(None, None, None)
        if self._disconnected.done() and not self._disconnected.cancelled():
            self._disconnected.exception()  # otherwise asyncio logs that the exception was never retrieved

    def _on_connect(
        self, client: Any, userdata: Any, flags: Any, reason_code: ReasonCode, properties: Properties | None = None
    ) -> None:
        if self._abandoned:
            client.disconnect()
            return
        most = getattr(properties, "ReceiveMaximum", None)
        if most is not None and most < client.max_inflight_messages:
            self._in_flight = asyncio.Semaphore(most)
        self._most_bytes = getattr(properties, "MaximumPacketSize", None)
        super()._on_connect(client, userdata, flags, reason_code, properties)

    def _on_disconnect(
        self,
        client: Any,
        userdata: Any,
        flags: DisconnectFlags,
        reason_code: ReasonCode,
        properties: Properties | None = None,
    ) -> None:
        if flags.is_disconnect_packet_from_server:
            self._why = words(reason_code)
        elif reason_code == "Keep alive timeout":
            self._why = "the broker gave no sign of life"
        if self._abandoned:
            return
        if not self._connected.done():
            self._connected.set_exception(ClosedError(self._why))
        if self._connected.cancelled():  # no caller waits any more; the base class would read its exception
            return
        super()._on_disconnect(client, userdata, flags, reason_code, properties)

    def _on_log(self, client: Any, userdata: Any, level: int, said: str) -> None:  # noqa: ARG002
        if said.startswith(SOCKET_BROKE):
            self._why = said.removeprefix(SOCKET_BROKE)

    def _on_socket_open(self, client: Any, userdata: Any, sock: Any) -> None:
        """Handle a new socket as the base class does; shut an abandoned one, because its loop may be about to end."""
        if self._abandoned:
            with contextlib.suppress(OSError):
                sock.shutdown(socket.SHUT_RDWR)
        else:
            super()._on_socket_open(client, userdata, sock)

    def _on_socket_register_write(self, client: Any, userdata: Any, sock: socket.socket) -> None:  # noqa: ARG002
        """Register the socket as the base class does, unless it was closed meanwhile or its number was reused."""

        def watch() -> None:
            if sock.fileno() >= 0:
                self._loop.add_writer(sock, client.loop_write)

        self._loop.call_soon_threadsafe(watch)

    def _on_publish(self, client: Any, userdata: Any, mid: int, reason_code: ReasonCode, properties: Any) -> None:  # noqa: ARG002
        answer = self._answers.get(mid)
        if answer is not None and not answer.done():
            answer.set_result(
                PublishRejection(words(reason_code), not is_final(reason_code)) if reason_code.is_failure else None
            )


@contextlib.asynccontextmanager
async def connected(
    arguments: dict[str, Any], protocol: ProtocolVersion, hello: ConnectOptions, patience: Timeouts
) -> AsyncIterator[Client]:
    """Connect while the context lasts; leaving it by an exception makes the broker publish the will.

    Raises:
        aiomqtt.MqttError: The broker cannot be reached, or refuses.
    """
    client = Client(arguments, protocol, hello, patience)
    try:
        await client.__aenter__()
    except BaseException:
        client.abandon()
        raise
    try:
        yield client
    except BaseException:
        client.drop_connection()
        raise
    finally:
        await client.end_session()


def refusal(error: aiomqtt.MqttError) -> str:
    """Why there is no connection."""
    if isinstance(error, aiomqtt.MqttCodeError) and isinstance(error.rc, ReasonCode):
        return words(error.rc)
    return str(error)


def should_retry_with_v311(error: aiomqtt.MqttError) -> bool:
    """Return True if a rejection of MQTT 5 may come from a broker with MQTT 3.1.1 only."""
    if isinstance(error, aiomqtt.MqttCodeError) and isinstance(error.rc, ReasonCode):
        return error.rc.value == UNSUPPORTED_VERSION
    return isinstance(error, ClosedError) and not str(error).startswith(TLS_ALERT)
