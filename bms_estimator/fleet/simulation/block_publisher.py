"""Publisher of simulated edges: sends their blocks over a few MQTT connections and receives the workers' replies.

One connection serves many edges. With a socket for each edge the operating system, not the fleet, would limit the load.
"""

import asyncio
import itertools
import time
import uuid
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

import paho.mqtt.client as mqtt
from paho.mqtt.enums import CallbackAPIVersion
from pydantic import ValidationError

from bms_estimator.edge.subjects import BlockRequest, block_request, raw
from bms_estimator.fleet.simulation.simulated_edges import SimulatedEdges
from bms_estimator.fleet.simulation.simulated_fleet import SimulatedFleet
from bms_estimator.mqtt.connection import brokers, tls_context
from bms_estimator.process.runtime import until_first_ends
from bms_estimator.settings.connections import MqttSettings

POLL_S = 0.1
"""Interval between two checks for due blocks [s]."""
MAX_IN_FLIGHT = 2000
"""Maximum number of blocks of a connection without an acknowledgment."""
QUIET_S = 3.0
"""Time after the last block during which a worker may request a missing one [s]."""
PROGRESS_S = 5.0
"""Interval between two progress lines [s]."""
KEEPALIVE_S = 20
"""MQTT keepalive interval [s]."""
MIN_RECONNECT_DELAY_S = 1
"""Minimum delay before a reconnect [s]."""
MAX_RECONNECT_DELAY_S = 4
"""Maximum delay before a reconnect [s]."""
_REPLIES = block_request("+").replace(".", "/")


class Report(NamedTuple):
    """Totals of a run."""

    blocks: int
    """Number of sent blocks, with repetitions."""
    repeated: int
    """Number of sent blocks that were sent before."""
    bytes: int
    """Total size of the blocks [bytes]."""
    resends: int
    """Number of resend requests of workers."""
    unacknowledged: int
    """Number of blocks without an acknowledgment."""
    lag_s: float
    """Age of the oldest due block that was not sent [s]."""

    def __str__(self) -> str:
        return (
            f"{self.blocks:,} blocks sent, {self.repeated:,} of them again after {self.resends:,} requests of workers, "
            f"{self.unacknowledged:,} not acknowledged, {self.lag_s:.1f} s behind"
        )


class _Connection:
    """MQTT connection that reconnects and resends unacknowledged blocks.

    Args:
        settings: MQTT settings; the brokers are tried in turn.
        replies: Receives the workers' replies as (topic, payload); None: no subscription.
    """

    def __init__(self, settings: MqttSettings, replies: deque[tuple[str, bytes]] | None) -> None:
        self._replies = replies
        self._brokers = itertools.cycle(brokers(settings))
        self.published, self.acknowledged = 0, 0
        self._client = mqtt.Client(CallbackAPIVersion.VERSION2, client_id=f"simulated-{uuid.uuid4().hex[:12]}")
        if any(broker.tls for broker in brokers(settings)):
            self._client.tls_set_context(tls_context(settings))
        self._client.max_inflight_messages_set(MAX_IN_FLIGHT)
        self._client.reconnect_delay_set(MIN_RECONNECT_DELAY_S, MAX_RECONNECT_DELAY_S)
        self._client.on_connect = self._on_connect
        self._client.on_publish = self._on_publish
        self._client.on_message = self._on_message
        self._client.on_connect_fail = self._client.on_disconnect = self._use_next_broker
        self._use_next_broker()
        self._client.loop_start()

    @property
    def in_flight(self) -> int:
        """Number of blocks without an acknowledgment."""
        return self.published - self.acknowledged

    def publish(self, topic: str, payload: bytes) -> None:
        """Queue a block for sending."""
        self._client.publish(topic, payload, qos=1)
        self.published += 1

    def end(self) -> None:
        """Disconnect."""
        self._client.disconnect()
        self._client.loop_stop()

    def _use_next_broker(self, *_: object) -> None:
        """Use the next broker in the next connection attempt."""
        broker = next(self._brokers)
        self._client.connect_async(broker.host, broker.port, KEEPALIVE_S)

    def _on_connect(self, client: mqtt.Client, *_: object) -> None:
        if self._replies is not None:
            client.subscribe(_REPLIES)

    def _on_publish(self, *_: object) -> None:
        self.acknowledged += 1  # called only in the connection's thread

    def _on_message(self, _client: mqtt.Client, _data: Any, message: mqtt.MQTTMessage) -> None:
        if self._replies is not None:
            self._replies.append((message.topic, bytes(message.payload)))


async def run_edges(
    fleet: SimulatedFleet,
    edges: SimulatedEdges,
    settings: MqttSettings,
    *,
    connections: int,
    stop: asyncio.Event,
    report: Callable[[str], object],
    quiet_s: float = QUIET_S,
) -> Report:
    """Send blocks when they are due, until ``stop`` is set or all edges have sent their last block.

    Args:
        fleet: Simulated packs.
        edges: Simulated edges.
        settings: Address of the server.
        connections: Number of connections for all edges.
        stop: Ends the run when set.
        report: Receives progress lines.
        quiet_s: Time after the last block in which workers may request missing blocks [s].

    Raises:
        UserError: An address cannot be used.
    """
    replies: deque[tuple[str, bytes]] = deque()
    # only the first connection subscribes, because the replies to all edges arrive on it
    open_connections = [_Connection(settings, None if i else replies) for i in range(connections)]
    topics = [raw(name).replace(".", "/") for name in fleet.names]
    sent_bytes, last_progress_s, last_busy_s = 0, time.monotonic(), time.monotonic()
    try:
        while not stop.is_set() and time.monotonic() - last_busy_s < quiet_s:
            await until_first_ends(asyncio.sleep(POLL_S), stop.wait())
            _process_replies(replies, edges)
            sent_bytes += _send(fleet, edges, open_connections, topics)
            if not edges.done or any(connection.in_flight for connection in open_connections):
                last_busy_s = time.monotonic()
            if time.monotonic() - last_progress_s >= PROGRESS_S:
                last_progress_s = time.monotonic()
                report(str(_report(edges, open_connections, sent_bytes)))
        return _report(edges, open_connections, sent_bytes)
    finally:
        for connection in open_connections:
            await asyncio.to_thread(connection.end)


def _process_replies(replies: deque[tuple[str, bytes]], edges: SimulatedEdges) -> None:
    while replies:
        topic, payload = replies.popleft()
        try:
            reply = BlockRequest.model_validate_json(payload)
        except ValidationError:
            continue  # a message of another client
        edges.receive_reply(topic.split("/")[1], reply, time.monotonic())


def _send(fleet: SimulatedFleet, edges: SimulatedEdges, open_connections: list[_Connection], topics: list[str]) -> int:
    """Send due blocks within the limit of messages in flight; return their size [bytes]."""
    capacity = min(MAX_IN_FLIGHT - connection.in_flight for connection in open_connections)
    due = edges.due(time.time(), max(0, capacity))
    # all blocks are computed before the first one is published, because the connections' threads would slow down this one
    blocks = list(fleet.blocks(*due))
    for pack, block in zip(due.packs.tolist(), blocks, strict=True):
        open_connections[pack % len(open_connections)].publish(topics[pack], block)
    return sum(map(len, blocks))


def _report(edges: SimulatedEdges, open_connections: list[_Connection], sent_bytes: int) -> Report:
    unacknowledged = sum(connection.in_flight for connection in open_connections)
    return Report(edges.sent, edges.repeated, sent_bytes, edges.resends, unacknowledged, edges.lag_s(time.time()))
