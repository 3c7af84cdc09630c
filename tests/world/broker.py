"""The broker, and the client library's way to it: what paho does is done here, all above that is the service's own.

A connection carries packets both ways in order, with delays. It can be cut, so that both ends see it; half open, so that
neither does; and the broker can be down, frozen, restarted with or without what it retained, or older than MQTT 5.
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

LATE_S = 0.03
"""Maximum delay of a packet [s]."""
CONNECT_TIMEOUT_S = 5.0
"""Timeout of paho for a host that does not respond [s]."""
KEEPALIVE_CHECK_S = 2.0
"""Interval between two keepalive checks [s]."""
REFUSED_VERSION = ReasonCode(PacketTypes.CONNACK, identifier=132)
ACCEPTED = ReasonCode(PacketTypes.CONNACK, identifier=0)
TAKEN = ReasonCode(PacketTypes.PUBACK, identifier=0)
LOST = ReasonCode(PacketTypes.DISCONNECT, "Unspecified error")
SILENT = ReasonCode(PacketTypes.DISCONNECT, "Keep alive timeout")
PARTED = ReasonCode(PacketTypes.DISCONNECT, "Normal disconnection")
NO_FLAGS = SimpleNamespace(is_disconnect_packet_from_server=False, session_present=False)
MAX_IN_FLIGHT = 20
GRANTED = ReasonCode(PacketTypes.SUBACK, identifier=0)


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
    """TCP connection, possibly half open without either side noticing."""

    client: "VirtualPaho"
    loop: ProcessLoop
    half_open: bool = False
    client_open: bool = True
    broker_open: bool = True
    accepted: bool = False
    to_broker_s: float = 0.0
    to_client_s: float = 0.0
    heard_by_broker_s: float = 0.0
    heard_by_client_s: float = 0.0
    said_by_client_s: float = 0.0
    pinged_s: float | None = None
    wanted: list[str] = field(default_factory=list)
    acknowledged: dict[int, float] = field(default_factory=dict)
    """QoS 1 messages whose acknowledgment the client has received, with the time [s]."""

    @property
    def usable(self) -> bool:
        """Whether the client can send.

        Raises:
            KilledError: Its process has ended; what is thrown away with it sends nothing.
        """
        if not self.loop.alive:
            raise KilledError
        return self.client_open


class Broker:
    """One broker.

    Args:
        timeline: The world's.
        dice: Delays.
        received: Told of each message that it takes: the message, and on which connection; None: its own, such as a will.
    """

    def __init__(
        self, timeline: Timeline, dice: random.Random, received: Callable[[Packet, Connection | None], None]
    ) -> None:
        self._timeline, self._dice, self._received = timeline, dice, received
        self.up = True
        self.reachable = True
        self.knows_five = True
        self.frozen_until_s = 0.0
        self.retained: dict[str, bytes] = {}
        self.connections: list[Connection] = []
        self.loop: ProcessLoop | None = None
        """Loop of the process that connects now."""

    # faults

    def stop(self, *, forgets: bool) -> None:
        """Stop the broker; all clients notice."""
        self.up = False
        for connection in list(self.connections):
            self._end(connection, says_will=False)
            self._hang_up(connection)
        if forgets:
            self.retained.clear()

    def start(self) -> None:
        """Start the broker again."""
        self.up = True
        self.frozen_until_s = 0.0

    def drop(self) -> None:
        """Cut all connections; both ends notice."""
        for connection in list(self.connections):
            self._end(connection, says_will=True)
            self._hang_up(connection)

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
                    self._send_to_broker(connection, lambda c=connection: self._end(c, says_will=True))

    def say(self, topic: str, payload: bytes, *, retain: bool = False) -> None:
        """Publish as another client."""
        if self.up:
            self._take(Packet(topic, payload, 0, retain, 0), None)

    # requests of clients

    def connect(self, client: "VirtualPaho") -> Connection:
        """A client opens a connection.

        Raises:
            LateError: Nobody answers.
            ConnectionRefusedError: The broker is down.
        """
        if self.loop is None or not self.reachable:
            raise LateError(CONNECT_TIMEOUT_S, TimeoutError("timed out"))
        if not self.up:
            raise ConnectionRefusedError(111, "Connection refused")
        connection = Connection(client, self.loop, half_open=False)
        connection.heard_by_broker_s = connection.heard_by_client_s = self._timeline.now_s
        self.connections.append(connection)
        self._send_to_broker(connection, lambda: self._greet(connection))
        self._timeline.after(KEEPALIVE_CHECK_S, lambda: self._look(connection))
        return connection

    def publish(self, connection: Connection, packet: Packet) -> None:
        """Send a client's message to the broker."""
        self._send_to_broker(connection, lambda: self._take_from(connection, packet))

    def subscribe(self, connection: Connection, topics: list[str], mid: int) -> None:
        """Send a client's subscription to the broker."""
        self._send_to_broker(connection, lambda: self._subscribe(connection, topics, mid))

    def disconnect(self, connection: Connection) -> None:
        """Disconnect a client cleanly."""
        self._send_to_broker(connection, lambda: self._end(connection, says_will=False))
        connection.client_open = False

    # behavior

    def _greet(self, connection: Connection) -> None:
        client = connection.client
        if client.protocol == paho.MQTTv5 and not self.knows_five:
            self._send_to_client(connection, lambda: client.on_connect(client, None, NO_FLAGS, REFUSED_VERSION, None))
            self._end(connection, says_will=False)
            return
        for other in list(self.connections):
            if other is not connection and other.accepted and other.client.identifier == client.identifier:
                self._end(other, says_will=True)
                self._hang_up(other)
        connection.accepted = True
        self._send_to_client(connection, lambda: client.connected(ACCEPTED))

    def _take_from(self, connection: Connection, packet: Packet) -> None:
        self._take(packet, connection)
        if packet.qos:

            def acknowledge() -> None:
                connection.acknowledged[packet.mid] = self._timeline.now_s
                connection.client.on_publish(connection.client, None, packet.mid, TAKEN, None)

            self._send_to_client(connection, acknowledge)

    def _take(self, packet: Packet, source: Connection | None) -> None:
        if packet.retain:
            if packet.payload:
                self.retained[packet.topic] = packet.payload
            else:
                self.retained.pop(packet.topic, None)
        self._received(packet, source)
        for connection in self.connections:
            if any(matches(packet.topic, wanted) for wanted in connection.wanted):
                as_published = packet.retain and "/request/" in packet.topic
                self._hand_on(connection, packet.topic, packet.payload, retain=as_published)

    def _subscribe(self, connection: Connection, topics: list[str], mid: int) -> None:
        connection.wanted += topics
        client = connection.client
        self._send_to_client(connection, lambda: client.on_subscribe(client, None, mid, [GRANTED] * len(topics), None))
        for topic, payload in self.retained.items():
            if any(matches(topic, wanted) for wanted in topics):
                self._hand_on(connection, topic, payload, retain=True)

    def _hand_on(self, connection: Connection, topic: str, payload: bytes, *, retain: bool) -> None:
        message = SimpleNamespace(topic=topic, payload=payload, qos=0, retain=retain, mid=0)
        client = connection.client
        self._send_to_client(connection, lambda: client.on_message(client, None, message))

    def _end(self, connection: Connection, *, says_will: bool) -> None:
        """End a connection at the broker."""
        if not connection.broker_open:
            return
        connection.broker_open = False
        self.connections.remove(connection)
        will = connection.client.will
        if says_will and connection.accepted and will is not None and self.up:
            self._take(will, None)

    def _hang_up(self, connection: Connection) -> None:
        """End a connection at the client."""
        self._send_to_client(connection, lambda: connection.client.lost(LOST))

    def _look(self, connection: Connection) -> None:
        """Check the keepalive of both sides."""
        now_s, keepalive_s = self._timeline.now_s, connection.client.keepalive_s
        if (
            connection.broker_open
            and connection.heard_by_broker_s < now_s - 1.5 * keepalive_s
            and (now_s >= self.frozen_until_s)
        ):
            self._end(connection, says_will=True)
            self._hang_up(connection)
        if connection.client_open and connection.loop.alive and now_s >= connection.loop.frozen_until_s:
            if connection.pinged_s is not None and now_s - connection.pinged_s >= keepalive_s:
                connection.loop.call_soon(connection.client.lost, SILENT)
            elif connection.pinged_s is None and (
                min(connection.heard_by_client_s, connection.said_by_client_s) <= now_s - keepalive_s
            ):
                connection.pinged_s = now_s
                self._send_to_broker(connection, lambda: self._send_to_client(connection, lambda: None))
        if connection.broker_open or (connection.client_open and connection.loop.alive):
            self._timeline.after(KEEPALIVE_CHECK_S, lambda: self._look(connection))

    def _send_to_broker(self, connection: Connection, packet: Callable[[], None]) -> None:
        connection.said_by_client_s = now_s = self._timeline.now_s
        connection.to_broker_s = max(connection.to_broker_s, now_s) + self._dice.uniform(0.0005, LATE_S)
        self._timeline.at(connection.to_broker_s, lambda: self._arrive(connection, packet))

    def _arrive(self, connection: Connection, packet: Callable[[], None]) -> None:
        """Deliver a packet to the broker."""
        if connection.half_open or not connection.broker_open:
            return
        if self._timeline.now_s < self.frozen_until_s:
            connection.to_broker_s = max(connection.to_broker_s, self.frozen_until_s) + 1e-6
            self._timeline.at(connection.to_broker_s, lambda: self._arrive(connection, packet))
            return
        connection.heard_by_broker_s = self._timeline.now_s
        packet()

    def _send_to_client(self, connection: Connection, packet: Callable[[], None]) -> None:
        connection.to_client_s = max(connection.to_client_s, self._timeline.now_s) + self._dice.uniform(0.0005, LATE_S)

        def arrive() -> None:
            if connection.half_open or not connection.client_open or not connection.loop.alive:
                return
            connection.heard_by_client_s, connection.pinged_s = self._timeline.now_s, None
            connection.loop.call_soon(packet)

        self._timeline.at(connection.to_client_s, arrive)

    @contextlib.contextmanager
    def installed(self) -> Iterator[None]:
        """Replace paho in aiomqtt, so that any address leads to this broker."""
        kept = paho.Client
        paho.Client = partial(VirtualPaho, self)
        try:
            yield
        finally:
            paho.Client = kept


class VirtualPaho:
    """Paho's client as far as aiomqtt uses it."""

    def __init__(self, broker: Broker, **arguments: Any) -> None:
        self._broker = broker
        self.identifier, self.protocol = arguments["client_id"], arguments["protocol"]
        self._client_id = (self.identifier or "").encode()
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

    def connect(self, *address: Any) -> None:
        self.keepalive_s = address[2]
        self._connection = self._broker.connect(self)

    def connected(self, code: ReasonCode) -> None:
        self.on_connect(self, None, NO_FLAGS, code, None)

    def lost(self, code: ReasonCode) -> None:
        if self._connection is not None and self._connection.client_open:
            self._connection.client_open = False
            connection = self._connection
            self._broker._send_to_broker(connection, lambda: self._broker._end(connection, says_will=True))
            self.on_disconnect(self, None, NO_FLAGS, code, None)

    def socket(self) -> Any:
        return SimpleNamespace(shutdown=lambda _: self.lost(LOST))

    def publish(self, topic: str, payload: bytes, qos: int, retain: bool, *_: Any) -> Any:
        self._mid += 1
        mid = self._mid
        connection = self._connection
        if connection is None or not connection.usable:
            return SimpleNamespace(rc=paho.MQTT_ERR_NO_CONN, mid=mid, is_published=lambda: False)
        self._broker.publish(connection, Packet(topic, payload, qos, retain, mid))
        if not qos:  # the operating system has buffered it
            connection.loop.call_soon(self.on_publish, self, None, mid, TAKEN, None)
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
        connection.loop.call_soon(self.on_disconnect, self, None, NO_FLAGS, PARTED, None)
        return int(paho.MQTT_ERR_SUCCESS)


def _ignored(*_: Any, **__: Any) -> None:
    pass


def matches(topic: str, wanted: str) -> bool:
    """Return True if a topic matches a filter without #."""
    if "+" not in wanted:
        return topic == wanted
    left, right = topic.split("/"), wanted.split("/")
    return len(left) == len(right) and all(b in ("+", a) for a, b in zip(left, right, strict=True))
