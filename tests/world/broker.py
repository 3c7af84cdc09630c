"""Simulated MQTT broker, and a replacement of the paho client. All code above paho is that of the service.

A connection carries packets in both directions in order, with random delays. A connection can be cut, which both ends
notice, or half open, which neither notices. The broker can be down, frozen, restarted with or without its retained
messages, or limited to MQTT 3.1.1.
"""

import contextlib
import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from types import SimpleNamespace
from typing import Any

from paho.mqtt import client as paho
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.reasoncodes import ReasonCode

from tests.world.loop import KilledError, ProcessLoop, Timeline

MIN_DELAY_S, MAX_DELAY_S = 0.0005, 0.03
"""Range of the delay of a packet [s]."""
CONNECT_TIMEOUT_S = 5.0
"""Timeout of paho for a host that does not respond [s]."""
KEEPALIVE_CHECK_S = 2.0
"""Interval between two keepalive checks [s]."""
UNSUPPORTED_VERSION = ReasonCode(PacketTypes.CONNACK, identifier=0x84)
CONNACK_OK = ReasonCode(PacketTypes.CONNACK, identifier=0)
PUBACK_OK = ReasonCode(PacketTypes.PUBACK, identifier=0)
CONNECTION_LOST = ReasonCode(PacketTypes.DISCONNECT, "Unspecified error")
KEEPALIVE_TIMEOUT = ReasonCode(PacketTypes.DISCONNECT, "Keep alive timeout")
NORMAL_DISCONNECT = ReasonCode(PacketTypes.DISCONNECT, "Normal disconnection")
NO_FLAGS = SimpleNamespace(is_disconnect_packet_from_server=False, session_present=False)
MAX_IN_FLIGHT = 20
"""Maximum number of QoS 1 messages without an acknowledgment; the default of paho."""
KEEPALIVE_TOLERANCE = 1.5
"""Keepalive intervals without a packet after which a broker ends a connection (section 3.1.2.10 of MQTT 5)."""
SUBACK_OK = ReasonCode(PacketTypes.SUBACK, identifier=0)


class LateError(Exception):
    """Error that a call raises after some time."""

    def __init__(self, seconds: float, error: OSError) -> None:
        super().__init__(seconds, error)
        self.seconds, self.error = seconds, error


@dataclass(frozen=True)
class Packet:
    """Message from a client to the broker."""

    topic: str
    payload: bytes
    qos: int
    retain: bool
    mid: int


@dataclass
class Connection:
    """TCP connection.

    Attributes:
        half_open: True if all packets are lost and neither end notices.
        client_open: True if the connection is open at the client.
        broker_open: True if the connection is open at the broker.
        accepted: True if the broker has accepted the client.
        arrival_at_broker_s: Arrival of the last packet that the client has sent; later packets arrive after it [s].
        arrival_at_client_s: Arrival of the last packet that the broker has sent; later packets arrive after it [s].
        received_by_broker_s: Time of the last packet that the broker has received [s].
        received_by_client_s: Time of the last packet that the client has received [s].
        sent_by_client_s: Time of the last packet that the client has sent [s].
        pinged_s: Time of an unanswered ping [s]; None: all pings are answered.
        topic_filters: Subscriptions of the client.
    """

    client: "VirtualPaho"
    loop: ProcessLoop
    half_open: bool = False
    client_open: bool = True
    broker_open: bool = True
    accepted: bool = False
    arrival_at_broker_s: float = 0.0
    arrival_at_client_s: float = 0.0
    received_by_broker_s: float = 0.0
    received_by_client_s: float = 0.0
    sent_by_client_s: float = 0.0
    pinged_s: float | None = None
    topic_filters: list[str] = field(default_factory=list)
    acknowledged: dict[int, float] = field(default_factory=dict)
    """QoS 1 messages whose acknowledgment the client has received, with the time [s]."""

    @property
    def usable(self) -> bool:
        """True if the client can send.

        Raises:
            KilledError: The client's process has ended. Its remaining objects must not send anything.
        """
        if not self.loop.alive:
            raise KilledError
        return self.client_open


class Broker:
    """MQTT broker.

    Args:
        timeline: Timeline of the world.
        dice: Generator of the random delays.
        received: Called with each received message and its connection; None: a will, or a message of another client.
    """

    def __init__(
        self, timeline: Timeline, dice: random.Random, received: Callable[[Packet, Connection | None], None]
    ) -> None:
        self._timeline, self._dice, self._received = timeline, dice, received
        self.up = True
        self.reachable = True
        self.supports_mqtt5 = True
        self.frozen_until_s = 0.0
        self.retained: dict[str, bytes] = {}
        self.connections: list[Connection] = []
        self.loop: ProcessLoop | None = None
        """Loop of the running process, whose clients may connect; None: no process runs."""

    # faults

    def stop(self, *, loses_retained: bool) -> None:
        """Stop the broker; all clients notice."""
        self.up = False
        for connection in list(self.connections):
            self._end_at_broker(connection, publishes_will=False)
            self._end_at_client(connection)
        if loses_retained:
            self.retained.clear()

    def start(self) -> None:
        """Start the broker again."""
        self.up = True
        self.frozen_until_s = 0.0

    def drop(self) -> None:
        """Cut all connections; both ends notice."""
        for connection in list(self.connections):
            self._end_at_broker(connection, publishes_will=True)
            self._end_at_client(connection)

    def half_open(self) -> None:
        """Make all connections half open: packets are lost, and neither end notices."""
        for connection in self.connections:
            connection.half_open = True

    def process_ended(self, loop: ProcessLoop, *, silently: bool) -> None:
        """End the connections of a process; ``silently``: without closing them, because the machine has ended too."""
        for connection in list(self.connections):
            if connection.loop is loop:
                connection.client_open = False
                if silently:
                    connection.half_open = True
                else:
                    self._send_to_broker(connection, lambda c=connection: self._end_at_broker(c, publishes_will=True))

    def publish_as_other(self, topic: str, payload: bytes, *, retain: bool = False) -> None:
        """Publish a message of another client."""
        if self.up:
            self._receive(Packet(topic, payload, 0, retain, 0), None)

    # packets from clients

    def connect(self, client: "VirtualPaho") -> Connection:
        """Open a connection of a client.

        Raises:
            LateError: The host does not respond.
            ConnectionRefusedError: The broker is down.
        """
        if self.loop is None or not self.reachable:
            raise LateError(CONNECT_TIMEOUT_S, TimeoutError("timed out"))
        if not self.up:
            raise ConnectionRefusedError(111, "Connection refused")
        connection = Connection(client, self.loop)
        connection.received_by_broker_s = connection.received_by_client_s = self._timeline.now_s
        self.connections.append(connection)
        self._send_to_broker(connection, lambda: self._accept(connection))
        self._timeline.after(KEEPALIVE_CHECK_S, lambda: self._check_keepalive(connection))
        return connection

    def publish(self, connection: Connection, packet: Packet) -> None:
        """Send a client's message to the broker."""
        self._send_to_broker(connection, lambda: self._receive_from(connection, packet))

    def subscribe(self, connection: Connection, topics: list[str], mid: int) -> None:
        """Send a client's subscription to the broker."""
        self._send_to_broker(connection, lambda: self._subscribe(connection, topics, mid))

    def disconnect(self, connection: Connection) -> None:
        """Disconnect a client cleanly."""
        self._send_to_broker(connection, lambda: self._end_at_broker(connection, publishes_will=False))
        connection.client_open = False

    # behavior

    def _accept(self, connection: Connection) -> None:
        client = connection.client
        if client.protocol == paho.MQTTv5 and not self.supports_mqtt5:
            self._send_to_client(
                connection, lambda: client.on_connect(client, None, NO_FLAGS, UNSUPPORTED_VERSION, None)
            )
            self._end_at_broker(connection, publishes_will=False)
            return
        # A new connection with the same client identifier replaces the old one.
        for other in list(self.connections):
            if other is not connection and other.accepted and other.client.identifier == client.identifier:
                self._end_at_broker(other, publishes_will=True)
                self._end_at_client(other)
        connection.accepted = True
        self._send_to_client(connection, lambda: client.on_connack(CONNACK_OK))

    def _receive_from(self, connection: Connection, packet: Packet) -> None:
        self._receive(packet, connection)
        if packet.qos:

            def acknowledge() -> None:
                connection.acknowledged[packet.mid] = self._timeline.now_s
                connection.client.on_publish(connection.client, None, packet.mid, PUBACK_OK, None)

            self._send_to_client(connection, acknowledge)

    def _receive(self, packet: Packet, source: Connection | None) -> None:
        if packet.retain:
            if packet.payload:
                self.retained[packet.topic] = packet.payload
            else:
                self.retained.pop(packet.topic, None)
        self._received(packet, source)
        for connection in self.connections:
            if any(matches(packet.topic, topic_filter) for topic_filter in connection.topic_filters):
                # The service subscribes to requests with "retain as published", to other topics without.
                retain = packet.retain and "/request/" in packet.topic
                self._forward(connection, packet.topic, packet.payload, retain=retain)

    def _subscribe(self, connection: Connection, topics: list[str], mid: int) -> None:
        connection.topic_filters += topics
        client = connection.client
        self._send_to_client(
            connection, lambda: client.on_subscribe(client, None, mid, [SUBACK_OK] * len(topics), None)
        )
        for topic, payload in self.retained.items():
            if any(matches(topic, topic_filter) for topic_filter in topics):
                self._forward(connection, topic, payload, retain=True)

    def _forward(self, connection: Connection, topic: str, payload: bytes, *, retain: bool) -> None:
        message = SimpleNamespace(topic=topic, payload=payload, qos=0, retain=retain, mid=0)
        client = connection.client
        self._send_to_client(connection, lambda: client.on_message(client, None, message))

    def _end_at_broker(self, connection: Connection, *, publishes_will: bool) -> None:
        if not connection.broker_open:
            return
        connection.broker_open = False
        self.connections.remove(connection)
        will = connection.client.will
        if publishes_will and connection.accepted and will is not None and self.up:
            self._receive(will, None)

    def _end_at_client(self, connection: Connection) -> None:
        self._send_to_client(connection, lambda: connection.client.on_loss(CONNECTION_LOST))

    def _check_keepalive(self, connection: Connection) -> None:
        """Check the keepalive of both sides."""
        now_s, keepalive_s = self._timeline.now_s, connection.client.keepalive_s
        if (
            connection.broker_open
            and connection.received_by_broker_s < now_s - KEEPALIVE_TOLERANCE * keepalive_s
            and now_s >= self.frozen_until_s
        ):
            self._end_at_broker(connection, publishes_will=True)
            self._end_at_client(connection)
        if connection.client_open and connection.loop.alive and now_s >= connection.loop.frozen_until_s:
            if connection.pinged_s is not None and now_s - connection.pinged_s >= keepalive_s:
                connection.loop.call_soon(connection.client.on_loss, KEEPALIVE_TIMEOUT)
            elif connection.pinged_s is None and (
                min(connection.received_by_client_s, connection.sent_by_client_s) <= now_s - keepalive_s
            ):
                # A ping and its response, which have no effect except on the times of the connection.
                connection.pinged_s = now_s
                self._send_to_broker(connection, lambda: self._send_to_client(connection, lambda: None))
        if connection.broker_open or (connection.client_open and connection.loop.alive):
            self._timeline.after(KEEPALIVE_CHECK_S, lambda: self._check_keepalive(connection))

    def _send_to_broker(self, connection: Connection, on_arrival: Callable[[], None]) -> None:
        """Send a packet, whose effect at the broker is ``on_arrival``."""
        connection.sent_by_client_s = now_s = self._timeline.now_s
        delay_s = self._dice.uniform(MIN_DELAY_S, MAX_DELAY_S)
        connection.arrival_at_broker_s = max(connection.arrival_at_broker_s, now_s) + delay_s
        self._timeline.at(connection.arrival_at_broker_s, lambda: self._arrive_at_broker(connection, on_arrival))

    def _arrive_at_broker(self, connection: Connection, on_arrival: Callable[[], None]) -> None:
        if connection.half_open or not connection.broker_open:
            return
        if self._timeline.now_s < self.frozen_until_s:
            # Packets wait for the end of the freeze; a microsecond between them preserves their order.
            connection.arrival_at_broker_s = max(connection.arrival_at_broker_s, self.frozen_until_s) + 1e-6
            self._timeline.at(connection.arrival_at_broker_s, lambda: self._arrive_at_broker(connection, on_arrival))
            return
        connection.received_by_broker_s = self._timeline.now_s
        on_arrival()

    def _send_to_client(self, connection: Connection, on_arrival: Callable[[], None]) -> None:
        """Send a packet, whose effect at the client is ``on_arrival``."""
        delay_s = self._dice.uniform(MIN_DELAY_S, MAX_DELAY_S)
        connection.arrival_at_client_s = max(connection.arrival_at_client_s, self._timeline.now_s) + delay_s

        def arrive() -> None:
            if connection.half_open or not connection.client_open or not connection.loop.alive:
                return
            connection.received_by_client_s, connection.pinged_s = self._timeline.now_s, None
            connection.loop.call_soon(on_arrival)

        self._timeline.at(connection.arrival_at_client_s, arrive)

    @contextlib.contextmanager
    def installed(self) -> Iterator[None]:
        """Replace paho in aiomqtt, so that any address leads to this broker."""
        original = paho.Client
        paho.Client = partial(VirtualPaho, self)
        try:
            yield
        finally:
            paho.Client = original


class VirtualPaho:
    """Replacement of paho's client, with the functions that aiomqtt uses."""

    def __init__(self, broker: Broker, **arguments: Any) -> None:
        self._broker = broker
        self.identifier, self.protocol = arguments["client_id"], arguments["protocol"]
        self._client_id = (self.identifier or "").encode()  # read by aiomqtt
        self.keepalive_s = 60.0
        self.will: Packet | None = None
        self.max_inflight_messages = MAX_IN_FLIGHT
        self._connection: Connection | None = None
        self._mid = 0
        self.on_connect = self.on_disconnect = self.on_subscribe = self.on_unsubscribe = _ignored
        self.on_message = self.on_publish = self.on_socket_open = self.on_socket_close = _ignored
        self.on_socket_register_write = self.on_socket_unregister_write = _ignored

    def __getattr__(self, name: str) -> Any:
        if name.endswith("_set") or name in ("enable_logger", "tls_set_context"):
            return _ignored
        raise AttributeError(name)

    def will_set(self, topic: str, payload: bytes, qos: int, retain: bool, *_: Any) -> None:
        self.will = Packet(topic, payload, qos, retain, 0)

    def connect(self, _host: str, _port: int, keepalive_s: float, *_: Any) -> None:
        self.keepalive_s = keepalive_s
        self._connection = self._broker.connect(self)

    def on_connack(self, code: ReasonCode) -> None:
        """Tell aiomqtt that the broker has accepted the connection."""
        self.on_connect(self, None, NO_FLAGS, code, None)

    def on_loss(self, code: ReasonCode) -> None:
        """Close a lost connection, and tell aiomqtt."""
        if self._connection is not None and self._connection.client_open:
            self._connection.client_open = False
            connection = self._connection
            self._broker._send_to_broker(
                connection, lambda: self._broker._end_at_broker(connection, publishes_will=True)
            )
            self.on_disconnect(self, None, NO_FLAGS, code, None)

    def loop_write(self) -> paho.MQTTErrorCode:
        return paho.MQTT_ERR_SUCCESS  # ``publish`` has sent the packet

    def socket(self) -> Any:
        return SimpleNamespace(shutdown=lambda _: self.on_loss(CONNECTION_LOST))

    def publish(self, topic: str, payload: bytes, qos: int, retain: bool, *_: Any) -> Any:
        self._mid += 1
        mid = self._mid
        connection = self._connection
        if connection is None or not connection.usable:
            return SimpleNamespace(rc=paho.MQTT_ERR_NO_CONN, mid=mid, is_published=lambda: False)
        self._broker.publish(connection, Packet(topic, payload, qos, retain, mid))
        if not qos:  # paho reports a QoS 0 message as published when the operating system has buffered it
            connection.loop.call_soon(self.on_publish, self, None, mid, PUBACK_OK, None)
        return SimpleNamespace(rc=paho.MQTT_ERR_SUCCESS, mid=mid, is_published=lambda: False)

    def subscribe(self, topics: Any, *_: Any) -> tuple[int, int | None]:
        if self._connection is None or not self._connection.usable:
            return paho.MQTT_ERR_NO_CONN, None
        self._mid += 1
        self._broker.subscribe(self._connection, [topic for topic, _ in topics], self._mid)
        return paho.MQTT_ERR_SUCCESS, self._mid

    def disconnect(self, *_: Any) -> int:
        connection = self._connection
        if connection is None or not connection.usable:
            return int(paho.MQTT_ERR_NO_CONN)
        self._broker.disconnect(connection)
        connection.loop.call_soon(self.on_disconnect, self, None, NO_FLAGS, NORMAL_DISCONNECT, None)
        return int(paho.MQTT_ERR_SUCCESS)


def _ignored(*_: Any, **__: Any) -> None:
    pass


def matches(topic: str, topic_filter: str) -> bool:
    """Return True if a topic matches a filter, which may contain + but not #."""
    if "+" not in topic_filter:
        return topic == topic_filter
    left, right = topic.split("/"), topic_filter.split("/")
    return len(left) == len(right) and all(b in ("+", a) for a, b in zip(left, right, strict=True))
