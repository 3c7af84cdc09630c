"""NATS as the broker: one node, and a cluster of which a node is killed in mid-stream."""

import asyncio
import json
import os
from pathlib import Path
from typing import Self

import aiomqtt
import pytest

from tests import nats
from tests.nats import Node, leader, running, skip_without_nats
from tests.sinks.service import STATE, Sink, assert_all_in_order, state, until

COUNT = 400
"""Number of states of the measurement in which none arrived."""


class Collector:
    """Receives the pack's messages over any live node without a loss: its session is in the cluster."""

    def __init__(self, nodes: list[Node]) -> None:
        self._nodes = nodes
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
            for node in self._nodes:
                try:
                    async with aiomqtt.Client(
                        "127.0.0.1", node.port, identifier="collector", clean_session=False
                    ) as client:
                        await client.subscribe([(STATE, 1), ("bms/pack/availability", 1)])
                        self._listening.set()
                        async for message in client.messages:
                            self._take(message)
                except aiomqtt.MqttError:
                    await asyncio.sleep(0.1)

    def _take(self, message: aiomqtt.Message) -> None:
        assert isinstance(message.payload, bytes)
        if message.topic.value == STATE:
            self.states.append(json.loads(message.payload)["frames_received"])
        else:
            self.availability.append(message.payload)


async def publish(sink: Sink, first: int, after: int) -> None:
    for number in range(first, after):
        sink.mqtt.publish(state(number))
        await asyncio.sleep(0.005)


async def test_one_node_that_is_killed_and_comes_back_gets_all_states(tmp_path: Path) -> None:
    skip_without_nats()
    with running(nats.alone(tmp_path)) as [node]:
        async with Collector([node]) as live, Sink(node.url, most_kept=10_000) as sink:
            await publish(sink, 0, COUNT // 2)
            await until(lambda: live.states)
            node.kill()
            await publish(sink, COUNT // 2, COUNT)
            node.start()
            await until(lambda: live.states and live.states[-1] == COUNT - 1)
            assert live.availability[-1] == b"online"
    assert_all_in_order(live.states, COUNT)


@pytest.mark.parametrize("serving", [pytest.param(True, id="serves us"), pytest.param(False, id="serves others")])
@pytest.mark.parametrize("leading", [pytest.param(True, id="leads"), pytest.param(False, id="follows")])
async def test_a_node_killed_in_mid_stream_costs_no_state(tmp_path: Path, *, serving: bool, leading: bool) -> None:
    skip_without_nats()
    if "CLUSTER" not in os.environ:
        pytest.skip("takes 6 to 30 s: part of `make nats`")
    with running(nats.three(tmp_path)) as nodes:
        async with Collector(nodes) as live:
            await until(lambda: leader(nodes))
            victim = next(node for node in nodes if (node.name == leader(nodes)) == leading)
            first = victim if serving else next(node for node in nodes if node is not victim)
            urls = tuple(node.url for node in (first, *(node for node in nodes if node is not first)))
            async with Sink(urls, most_kept=10_000) as sink:
                await until(lambda: live.availability == [b"online"])
                await publish(sink, 0, COUNT // 2)
                await until(lambda: len(live.states) > COUNT // 4)
                victim.kill()
                await publish(sink, COUNT // 2, COUNT)
                await until(lambda: live.states[-1] == COUNT - 1)
                await until(lambda: sink.delivery.waiting == 0)
                await until(lambda: live.availability[-1] == b"online")
    assert_all_in_order(live.states, COUNT)
    assert sink.delivery.drops == 0
