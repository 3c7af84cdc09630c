"""NATS as the broker: one node, and a cluster of which a node is killed in mid-stream."""

import asyncio
import json
import os
from pathlib import Path
from typing import Self

import aiomqtt
import pytest

from bms_estimator.mqtt.connection import ConnectOptions, brokers
from bms_estimator.mqtt.reconnect_loop import BrokerConnector
from bms_estimator.settings.connections import MqttSettings
from tests.fleet.nats_cluster import NatsCluster, running
from tests.patience import until
from tests.sinks.sink_helpers import STATE_TOPIC, Sink, assert_all_in_order, numbered_state

STATE_COUNT = 400
"""Number of published states, with the numbers 0 to ``STATE_COUNT`` - 1."""
MESSAGE_STREAM = "$MQTT_msgs"
"""Stream in which the server stores QoS 1 messages until all subscribers have them."""


class StateCollector:
    """Subscriber to the pack's messages at any live node. It loses none, because the cluster stores its session.

    Attributes:
        states: Numbers of the received states.
        availability: Received payloads of the service's availability.
    """

    def __init__(self, server: NatsCluster) -> None:
        self._ports = server.mqtt_ports
        self.states: list[int] = []
        self.availability: list[bytes] = []

    async def __aenter__(self) -> Self:
        self._listening = asyncio.Event()
        self._task = asyncio.create_task(self._listen())
        await self._listening.wait()
        return self

    async def __aexit__(self, *_: object) -> None:
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)

    async def _listen(self) -> None:
        while True:
            for port in self._ports:
                try:
                    async with aiomqtt.Client("127.0.0.1", port, identifier="collector", clean_session=False) as client:
                        await client.subscribe([(STATE_TOPIC, 1), ("bms/pack/availability", 1)])
                        self._listening.set()
                        async for message in client.messages:
                            self._record(message)
                except aiomqtt.MqttError:
                    await asyncio.sleep(0.1)

    def _record(self, message: aiomqtt.Message) -> None:
        assert isinstance(message.payload, bytes)
        if message.topic.value == STATE_TOPIC:
            # the field in which ``numbered_state`` stores the number
            self.states.append(json.loads(message.payload)["frames_received"])
        else:
            self.availability.append(message.payload)


async def publish(sink: Sink, first: int, end: int) -> None:
    """Publish the states ``first`` to ``end`` - 1 at 200 Hz."""
    for number in range(first, end):
        sink.mqtt.publish(numbered_state(number))
        await asyncio.sleep(0.005)


def mqtt_url(server: NatsCluster, node: int) -> str:
    """Return the URL of the node with this index."""
    return f"mqtt://127.0.0.1:{server.mqtt_ports[node]}"


async def test_all_states_arrive_although_the_only_node_is_killed_and_restarted(tmp_path: Path) -> None:
    with running(tmp_path) as server:
        async with StateCollector(server) as live, Sink(mqtt_url(server, 0), max_queued=10_000) as sink:
            await publish(sink, first=0, end=STATE_COUNT // 2)
            await until(lambda: live.states)
            server.kill(0)
            await publish(sink, first=STATE_COUNT // 2, end=STATE_COUNT)
            server.start(0)
            await until(lambda: live.states and live.states[-1] == STATE_COUNT - 1)
            assert live.availability[-1] == b"online"
    assert_all_in_order(live.states, STATE_COUNT)


@pytest.mark.parametrize(
    "serves_client", [pytest.param(True, id="serves the sink"), pytest.param(False, id="serves others")]
)
@pytest.mark.parametrize("is_leader", [pytest.param(True, id="leads"), pytest.param(False, id="follows")])
async def test_killed_cluster_node_loses_no_state(tmp_path: Path, *, serves_client: bool, is_leader: bool) -> None:
    if "CLUSTER" not in os.environ:
        pytest.skip("takes 6 to 30 s: part of `make nats`")
    with running(tmp_path, nodes=3) as server:
        async with StateCollector(server) as live:
            await until(lambda: server.leader(MESSAGE_STREAM) >= 0)
            leader = server.leader(MESSAGE_STREAM)
            victim = leader if is_leader else (leader + 1) % 3
            first_node = victim if serves_client else (victim + 1) % 3  # the sink connects to its first URL
            urls = tuple(mqtt_url(server, (first_node + i) % 3) for i in range(3))
            async with Sink(urls, max_queued=10_000) as sink:
                await until(lambda: live.availability == [b"online"])
                await publish(sink, first=0, end=STATE_COUNT // 2)
                await until(lambda: len(live.states) > STATE_COUNT // 4)
                server.kill(victim)
                await publish(sink, first=STATE_COUNT // 2, end=STATE_COUNT)
                await until(lambda: live.states[-1] == STATE_COUNT - 1)
                await until(lambda: sink.delivery.waiting == 0)
                await until(lambda: live.availability[-1] == b"online")
    assert_all_in_order(live.states, STATE_COUNT)
    assert sink.delivery.drops == 0


async def test_a_reconnect_takes_one_connection_although_the_server_rejects_mqtt_5(tmp_path: Path) -> None:
    with running(tmp_path) as server:
        settings = MqttSettings(url=f"mqtt://127.0.0.1:{server.mqtt_port}")
        connect, options = BrokerConnector(settings), ConnectOptions("edge", None, lambda _reason, _topic: None)
        totals = []
        for _ in range(3):
            async with connect(brokers(settings)[0], options) as connection:
                assert connection.protocol == "MQTT 3.1.1"
            totals.append(server.ask(0, "varz")["total_connections"])
        assert totals == [totals[0], totals[0] + 1, totals[0] + 2]
