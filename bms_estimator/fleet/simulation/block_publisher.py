"""Simulated edges on their way: blocks out over a few MQTT connections, and what workers await of them.

One connection serves many edges: one socket each would measure the kernel's sockets, not a fleet.
"""

import asyncio
import contextlib
import itertools
import time
import uuid
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

import paho.mqtt.client as mqtt
from paho.mqtt.enums import CallbackAPIVersion
from pydantic import ValidationError

from bms_estimator.edge.subjects import BlockRequest, awaits, raw
from bms_estimator.fleet.simulation.simulated_edges import SimulatedEdges
from bms_estimator.fleet.simulation.simulated_fleet import SimulatedFleet
from bms_estimator.mqtt.broker_config import brokers, password, tls_context
from bms_estimator.settings.mqtt import MqttSettings

ROUND_S = 0.1
"""Interval between two checks for due blocks [s]."""
MAX_IN_FLIGHT = 2000
"""Blocks that a connection may have sent without an acknowledgement."""
QUIET_S = 3.0
"""Time after the last block in which a worker may request a missing one [s]."""
SAID_S = 5.0
"""Interval between two progress lines [s]."""
KEEPALIVE_S = 20
MIN_WAIT_S, MAX_WAIT_S = 1, 4
"""Minimum and maximum delay before a reconnect [s]."""
_HEARD = awaits("+").replace(".", "/")


class Report(NamedTuple):
    """Result of publishing."""

    blocks: int
    """Sent, those sent again among them."""
    again: int
    bytes: int
    """Size of the blocks [bytes]."""
    resends: int
    """Requested by workers."""
    unacknowledged: int
    lag_s: float
    """Age of the oldest complete block that was not sent [s]."""

    def __str__(self) -> str:
        return (
            f"{self.blocks:,} blocks sent, {self.again:,} of them again as workers asked {self.resends:,} times, "
            f"{self.unacknowledged:,} not acknowledged, {self.lag_s:.1f} s behind"
        )


class _Connection:
    """One MQTT connection, made again whenever it breaks; what the broker has not acknowledged is sent again.

    Args:
        settings: The brokers, tried in turn.
        heard: Receives the payloads of ``BlockRequest`` with their topics; None: no subscription.
    """

    def __init__(self, settings: MqttSettings, heard: deque[tuple[str, bytes]] | None) -> None:
        self._heard = heard
        self._brokers = itertools.cycle(brokers(settings))
        self.published, self.acknowledged = 0, 0
        self._client = mqtt.Client(CallbackAPIVersion.VERSION2, client_id=f"simulated-{uuid.uuid4().hex[:12]}")
        self._client.username_pw_set(settings.username, password(settings))
        if any(broker.tls for broker in brokers(settings)):
            self._client.tls_set_context(tls_context(settings))
        self._client.max_inflight_messages_set(MAX_IN_FLIGHT)
        self._client.reconnect_delay_set(MIN_WAIT_S, MAX_WAIT_S)
        self._client.on_connect = self._subscribe
        self._client.on_publish = self._count
        self._client.on_message = self._on_message
        self._client.on_connect_fail = self._client.on_disconnect = self._turn
        self._turn()
        self._client.loop_start()

    @property
    def in_flight(self) -> int:
        """Blocks without an acknowledgement."""
        return self.published - self.acknowledged

    def publish(self, topic: str, payload: bytes) -> None:
        """Hand over a block; it is sent later if necessary."""
        self._client.publish(topic, payload, qos=1)
        self.published += 1

    def end(self) -> None:
        """Take leave of the broker."""
        self._client.disconnect()
        self._client.loop_stop()

    def _turn(self, *_: object) -> None:
        """Go to the next broker at the next attempt."""
        broker = next(self._brokers)
        self._client.connect_async(broker.host, broker.port, KEEPALIVE_S)

    def _subscribe(self, client: mqtt.Client, *_: object) -> None:
        if self._heard is not None:
            client.subscribe(_HEARD)

    def _count(self, *_: object) -> None:
        self.acknowledged += 1  # by the connection's own thread alone

    def _on_message(self, _client: mqtt.Client, _data: Any, message: mqtt.MQTTMessage) -> None:
        if self._heard is not None:
            self._heard.append((message.topic, bytes(message.payload)))


async def run_edges(
    fleet: SimulatedFleet,
    edges: SimulatedEdges,
    settings: MqttSettings,
    *,
    connections: int,
    stop: asyncio.Event,
    said: Callable[[str], object],
    quiet_s: float = QUIET_S,
) -> Report:
    """Send blocks as they are complete, until ``stop`` or until all edges have sent their last.

    Args:
        fleet: The packs.
        edges: Simulated edges.
        settings: Address and credentials of the server.
        connections: Number of connections for all edges.
        stop: Ends it.
        said: Receives progress messages.
        quiet_s: After the last block.

    Raises:
        UserError: An address, password or certificate cannot be used.
    """
    heard: deque[tuple[str, bytes]] = deque()
    links = [_Connection(settings, None if i else heard) for i in range(connections)]
    topics = [raw(name).replace(".", "/") for name in fleet.names]
    size, spoke_s, busy_s = 0, time.monotonic(), time.monotonic()
    try:
        while not await _ended(stop) and time.monotonic() - busy_s < quiet_s:
            _listen(heard, edges)
            size += _send(fleet, edges, links, topics)
            if not edges.done or any(link.in_flight for link in links):
                busy_s = time.monotonic()
            if time.monotonic() - spoke_s >= SAID_S:
                spoke_s = time.monotonic()
                said(str(_report(edges, links, size)))
        return _report(edges, links, size)
    finally:
        for link in links:
            await asyncio.to_thread(link.end)


async def _ended(stop: asyncio.Event) -> bool:
    """Return True if it should end; waits at most ``ROUND_S``."""
    with contextlib.suppress(TimeoutError):
        await asyncio.wait_for(stop.wait(), ROUND_S)
    return stop.is_set()


def _listen(heard: deque[tuple[str, bytes]], edges: SimulatedEdges) -> None:
    while heard:
        topic, payload = heard.popleft()
        try:
            answer = BlockRequest.model_validate_json(payload)
        except ValidationError:
            continue  # not a worker's
        edges.hear(topic.split("/")[1], answer, time.monotonic())


def _send(fleet: SimulatedFleet, edges: SimulatedEdges, links: list[_Connection], topics: list[str]) -> int:
    """Send due blocks within the limit of messages in flight. Returns how many bytes of blocks that was."""
    free = min(MAX_IN_FLIGHT - link.in_flight for link in links)
    due = edges.due(time.time(), max(0, free))
    blocks = list(fleet.blocks(*due))  # all of them first: the connections' threads would take turns with this one
    for pack, block in zip(due.packs.tolist(), blocks, strict=True):
        links[pack % len(links)].publish(topics[pack], block)
    return sum(map(len, blocks))


def _report(edges: SimulatedEdges, links: list[_Connection], size: int) -> Report:
    unacknowledged = sum(link.in_flight for link in links)
    return Report(edges.sent, edges.again, size, edges.resends, unacknowledged, edges.lag_s(time.time()))
