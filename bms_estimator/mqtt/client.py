"""Implementation of ``Connection`` by aiomqtt and paho, with readable errors.

Errors are described by MQTT 5 reason codes, to which paho translates the return codes of MQTT 3.1.1.
"""

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

from bms_estimator.mqtt.connection import (
    BrokerConnectionError,
    ConnectOptions,
    Message,
    PublishRejection,
    ReceivedMessage,
)
from bms_estimator.mqtt.receive_queue import ReceiveQueue

UNSUPPORTED_VERSION = 132
"""CONNACK code of a broker without MQTT 5."""

_NOT_ALLOWED = (
    "name or password wrong, or not allowed; "
    "see {section}.username, {section}.password_file and the broker's access list"
)
HINTS = {
    133: "another mqtt.base_topic or pack.name may help",  # client identifier not valid
    134: _NOT_ALLOWED,  # bad user name or password
    135: _NOT_ALLOWED,  # not authorized
    136: "the broker is not ready",  # server unavailable
    138: "the broker does not want this client",  # banned
    141: "it received nothing from this client for too long",  # keep alive timeout
    142: "another client has the same name",  # session taken over
    149: "a message is longer than the broker takes",  # packet too large
    151: "the broker allows no more",  # quota exceeded
    159: "too many connections in a short time",  # connection rate exceeded
}
"""Causes and remedies by reason code. ``section`` is the settings section of the broker."""

LOGIN_CODES = {134, 135}
"""Reason codes of a rejected connection with a wrong or missing user name or password."""

FINAL_CODES = {
    135,  # not authorized
    144,  # topic name invalid
    149,  # packet too large
    153,  # payload format invalid
}
"""Reason codes of permanent rejections. All other codes (busy, quota, unspecified) may be temporary."""


def describe_reason(reason: ReasonCode, section: str) -> str:
    """Return a reason code as text: name, number, hint.

    Args:
        reason: Reason code.
        section: Settings section of the broker.
    """
    hint = HINTS.get(reason.value, "").format(section=section)
    return f"{reason.getName()} ({reason.value})" + (f": {hint}" if hint else "")


DISCONNECT_TIMEOUT_S = 1.0
"""Timeout of DISCONNECT [s], which a broken connection would never complete."""
NO_DELAY = (socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
"""Socket option that sends small messages immediately, without Nagle's algorithm."""
MAX_OVERHEAD_BYTES = 16
"""Maximum size of a PUBLISH packet besides topic and payload [bytes]."""
SOCKET_ERROR_PREFIX = "failed to receive on socket: "
"""Beginning of paho's log line about a socket error."""
TLS_ERROR_PREFIX = "[SSL: "
"""Beginning of the text of a TLS error, such as an alert that the broker has sent."""

log = structlog.get_logger(__name__)


class _ToLog(logging.Handler):
    """Handler that forwards log lines of paho and aiomqtt. It skips socket errors, which the reconnect loop reports."""

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage()
        if not text.startswith(SOCKET_ERROR_PREFIX):
            log.warning("mqtt client", text=text)


_logger = logging.getLogger(__name__)
_logger.setLevel(logging.WARNING)
_logger.propagate = False
_logger.addHandler(_ToLog())


class Timeouts(NamedTuple):
    """Timeouts of a connection."""

    connect_s: float = 10.0
    """Total timeout of name resolution, TCP, TLS and the broker's CONNACK [s]."""
    keepalive_s: int = 10
    """MQTT keepalive interval [s]. A ping is sent after one interval and must be answered within another interval. The
    broker publishes the will of a silently lost client after 1.5 intervals."""
    acknowledge_s: float = 15.0
    """Timeout of PUBACK [s]. It exceeds the 10 s in which a NATS cluster elects a new leader."""


DEFAULT_TIMEOUTS = Timeouts()


class ClosedError(aiomqtt.MqttError):
    """The broker closed the connection instead of answering CONNECT."""


class Client(aiomqtt.Client):
    """Connection to a broker by one MQTT version.

    Args:
        arguments: Arguments of aiomqtt for address, user name, password and TLS.
        protocol: MQTT version.
        options: Connect options.
        timeouts: Timeouts after which the connection counts as lost.
        section: Settings section of the broker, for errors.
    """

    def __init__(
        self,
        arguments: dict[str, Any],
        protocol: ProtocolVersion,
        options: ConnectOptions,
        timeouts: Timeouts,
        section: str,
    ) -> None:
        connect_properties = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]  # paho has no types there
        connect_properties.MaximumPacketSize = options.max_bytes
        self._section, self._is_5 = section, protocol is ProtocolVersion.V5
        super().__init__(
            **arguments,
            protocol=protocol,
            properties=connect_properties if self._is_5 else None,
            identifier=options.identifier,
            will=aiomqtt.Will(*options.will) if options.will else None,
            keepalive=timeouts.keepalive_s,
            max_queued_incoming_messages=options.max_waiting,
            queue_type=partial(ReceiveQueue, options.on_message_lost, options.max_bytes),  # type: ignore[arg-type]  # aiomqtt only calls it
            socket_options=[NO_DELAY],
            logger=_logger,
        )
        self._acknowledge_s = timeouts.acknowledge_s
        self._client.on_log = self._on_log
        self.protocol = "MQTT 5" if self._is_5 else "MQTT 3.1.1"
        self._pending_acks: dict[int, asyncio.Future[PublishRejection | None]] = {}
        self._in_flight = asyncio.Semaphore(self._client.max_inflight_messages)
        self._max_bytes: int | None = None
        self._abandoned = False
        self._failure = "the connection broke"

    async def publish(self, message: Message) -> PublishRejection | None:  # type: ignore[override]
        """Publish as ``Connection`` specifies."""
        if (
            self._max_bytes is not None
            and MAX_OVERHEAD_BYTES + len(message.topic) + len(message.payload) > self._max_bytes
        ):
            # sending it would make the broker close the connection
            return PublishRejection(
                f"longer than the {self._max_bytes} bytes that the broker takes", is_retryable=False
            )
        async with self._in_flight:
            info = self._client.publish(*message)
            if info.rc != MQTTErrorCode.MQTT_ERR_SUCCESS:
                raise BrokerConnectionError(f"a message cannot be sent: {error_string(info.rc)}")
            answer: asyncio.Future[PublishRejection | None] = asyncio.get_running_loop().create_future()
            self._pending_acks[info.mid] = answer
            self._client.loop_write()  # send now, because other tasks may run before the event loop finds the socket writable
            try:
                await asyncio.wait([answer], timeout=self._acknowledge_s)
                # after a suspend, both answer and timeout may be due: an answer takes precedence
                if not answer.done():
                    raise BrokerConnectionError(
                        f"the broker has not acknowledged a message for {self._acknowledge_s:g} s"
                    )
                return answer.result()
            finally:
                self._pending_acks.pop(info.mid, None)

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
            topic: describe_reason(answer, self._section)
            for topic, answer in zip(topics, answers, strict=False)
            if isinstance(answer, ReasonCode) and answer.is_failure
        }

    async def receive(self) -> ReceivedMessage:
        """Receive as ``Connection`` specifies."""
        try:
            message = await anext(self.messages)
        except aiomqtt.MqttError:
            raise BrokerConnectionError(self._failure) from None
        return ReceivedMessage(message.topic.value, bytes(message.payload), bool(message.retain))

    def abandon(self) -> None:
        """Abandon a connection attempt. A later CONNACK is answered with DISCONNECT."""
        self._abandoned = True
        self._client.disconnect()

    def drop_connection(self) -> None:
        """Close the connection without DISCONNECT, so that the broker publishes the will."""
        sock: Any = self._client.socket()  # paho's socket protocol does not declare shutdown()
        if sock is not None:
            with contextlib.suppress(OSError):
                sock.shutdown(socket.SHUT_RDWR)

    async def end_session(self) -> None:
        """Close the connection, with DISCONNECT if possible."""
        with contextlib.suppress(TimeoutError, aiomqtt.MqttError):
            async with asyncio.timeout(DISCONNECT_TIMEOUT_S):
                await self.__aexit__(None, None, None)
        if self._disconnected.done() and not self._disconnected.cancelled():
            self._disconnected.exception()  # otherwise asyncio logs that the exception was never retrieved

    def _on_connect(
        self, client: Any, userdata: Any, flags: Any, reason_code: ReasonCode, properties: Properties | None = None
    ) -> None:
        if self._abandoned:
            client.disconnect()
            return
        receive_maximum = getattr(properties, "ReceiveMaximum", None)
        if receive_maximum is not None and receive_maximum < client.max_inflight_messages:
            self._in_flight = asyncio.Semaphore(receive_maximum)
        self._max_bytes = getattr(properties, "MaximumPacketSize", None)
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
            self._failure = describe_reason(reason_code, self._section)
        elif reason_code == "Keep alive timeout":
            self._failure = "the broker did not answer a ping"
        if self._abandoned:
            return
        if not self._connected.done():
            self._connected.set_exception(ClosedError(self._failure))
        if self._connected.cancelled():  # no caller waits, and the base class would raise CancelledError here
            return
        super()._on_disconnect(client, userdata, flags, reason_code, properties)

    def _on_log(self, client: Any, userdata: Any, level: int, text: str) -> None:  # noqa: ARG002
        if text.startswith(SOCKET_ERROR_PREFIX):
            self._failure = text.removeprefix(SOCKET_ERROR_PREFIX)

    def _on_socket_open(self, client: Any, userdata: Any, sock: Any) -> None:
        """Handle a new socket as the base class does. Shut down an abandoned socket: the event loop may be closing."""
        if self._abandoned:
            with contextlib.suppress(OSError):
                sock.shutdown(socket.SHUT_RDWR)
        else:
            super()._on_socket_open(client, userdata, sock)

    def _on_socket_register_write(self, client: Any, userdata: Any, sock: socket.socket) -> None:  # noqa: ARG002
        """Register the socket as the base class does, unless it was closed meanwhile and its descriptor reused.

        A socket without waiting packets is not registered, because ``publish`` has already sent them.
        """

        def watch() -> None:
            if sock.fileno() >= 0 and client.want_write():
                self._loop.add_writer(sock, client.loop_write)

        self._loop.call_soon_threadsafe(watch)

    def _on_publish(self, client: Any, userdata: Any, mid: int, reason_code: ReasonCode, properties: Any) -> None:  # noqa: ARG002
        answer = self._pending_acks.get(mid)
        if answer is not None and not answer.done():
            answer.set_result(
                PublishRejection(describe_reason(reason_code, self._section), reason_code.value not in FINAL_CODES)
                if reason_code.is_failure
                else None
            )


@contextlib.asynccontextmanager
async def open_client(
    arguments: dict[str, Any], protocol: ProtocolVersion, options: ConnectOptions, timeouts: Timeouts, section: str
) -> AsyncIterator[Client]:
    """Connect for the duration of the context. Leaving it by an exception makes the broker publish the will.

    The parameters are those of ``Client``.

    Raises:
        aiomqtt.MqttError: The broker cannot be reached, or refuses.
    """
    client = Client(arguments, protocol, options, timeouts, section)
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


def failure_reason(error: aiomqtt.MqttError, section: str) -> str:
    """Return the reason for which a connection to the broker of a settings section failed."""
    if isinstance(error, aiomqtt.MqttCodeError) and isinstance(error.rc, ReasonCode):
        return describe_reason(error.rc, section)
    return str(error)


def is_login_error(error: aiomqtt.MqttError) -> bool:
    """Return True if the broker rejects user name and password, or requires them."""
    return (
        isinstance(error, aiomqtt.MqttCodeError) and isinstance(error.rc, ReasonCode) and error.rc.value in LOGIN_CODES
    )


def should_retry_with_v311(error: aiomqtt.MqttError) -> bool:
    """Return True if a rejection of MQTT 5 may come from a broker with MQTT 3.1.1 only."""
    if isinstance(error, aiomqtt.MqttCodeError) and isinstance(error.rc, ReasonCode):
        return error.rc.value == UNSUPPORTED_VERSION
    return isinstance(error, ClosedError) and not str(error).startswith(TLS_ERROR_PREFIX)
