"""Block sender with a real server. After each kind of fault the received samples equal those sent, in order."""

import asyncio
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import numpy as np
import pytest

from bms_estimator.edge.block import decode
from bms_estimator.edge.block_sender import PACK, BlockSender
from bms_estimator.edge.subjects import BlockRequest
from bms_estimator.model.arrays import NO_CELLS, SAMPLE, CellBlock, SampleBlock
from bms_estimator.model.clock import Clock
from bms_estimator.model.errors import UserError
from bms_estimator.model.payloads.health import EdgeHealth
from bms_estimator.settings.connections import EdgeSettings
from tests.fleet.nats_cluster import NatsCluster, running
from tests.fleet.receiver import Receiver
from tests.mosquitto import Broker, Listener
from tests.mqtt.proxy import Proxy
from tests.patience import LONG_S, until

WALL_S = 1.7e9
"""Wall clock at the start [s since 1970]."""
SETTINGS = {"block_s": 60.0, "store_mib": 1.0}


@pytest.fixture(scope="module")
def engine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[NatsCluster]:
    with running(tmp_path_factory.mktemp("engine"), partitions=4) as engine:
        yield engine


@pytest.fixture
async def receiver(engine: NatsCluster, request: pytest.FixtureRequest) -> AsyncIterator[Receiver]:
    """Return the receiver of a pack that has the name of the test."""
    async with Receiver(engine.url, request.node.name.replace("[", "_").rstrip("]")[:64]) as receiver:
        yield receiver


class SimulatedEdge:
    """Block sender that gets one sample a second. ``add`` advances its clocks."""

    def __init__(self, receiver: Receiver, folder: Path, url: str, **settings: float) -> None:
        self.now_s, self.count, self._sent = 0.0, 0, list[SampleBlock]()
        self.receiver, self._random = receiver, np.random.default_rng(1)
        self.edge = BlockSender(
            EdgeSettings(url=url, **SETTINGS | settings),
            receiver.pack,
            folder,
            clock=Clock(wall=lambda: WALL_S + self.now_s),
            steady=lambda: self.now_s,
            first_delay_s=0.05,
            retry_s=0.05,
            final_send_timeout_s=LONG_S,
        )

    def add(self, minutes: float, cells_v: CellBlock = NO_CELLS) -> None:
        """Add the samples of a time, with voltages that differ from each other, each with the cell voltages ``cells_v``."""
        for _ in range(round(60 * minutes)):
            sample = np.zeros(1, dtype=SAMPLE)
            sample["time_s"], sample["voltage_v"] = self.now_s, 3.0 + 1e-6 * self.count
            sample["current_a"] = self._random.normal()
            for name in ("temperature_c", "temperature_min_c", "temperature_max_c"):
                sample[name] = np.nan
            self.edge.take(sample, cells_v)
            sample["time_s"] += WALL_S
            self._sent.append(sample)
            self.count, self.now_s = self.count + 1, self.now_s + 1.0

    async def assert_all_received(self) -> None:
        """Check that all samples of completed blocks have arrived bit for bit, once and in order."""
        completed = self.count - len(self.edge._batcher)  # the batcher holds the samples of the open block
        await self.receiver.wait_for_samples(completed)
        assert equal(self.receiver.samples, np.concatenate(self._sent[:completed]))


def equal(first: SampleBlock, second: SampleBlock) -> bool:
    """Return True if both are equal bit for bit, apart from padding between the columns."""
    return all(first[name].tobytes() == second[name].tobytes() for name in SAMPLE.names or ())


def url(engine: NatsCluster) -> str:
    return f"mqtt://127.0.0.1:{engine.mqtt_port}"


@pytest.mark.parametrize("cells", [False, True])
async def test_cell_voltages_are_sent_with_setting_cells_only(
    receiver: Receiver, engine: NatsCluster, tmp_path: Path, cells: bool
) -> None:
    simulated, cells_v = SimulatedEdge(receiver, tmp_path, url(engine), cells=cells), np.array([[3.31, 3.302, 3.3]])
    async with simulated.edge:
        simulated.add(2.5, cells_v)
        await simulated.assert_all_received()
    expected_v = np.tile(cells_v, (60, 1)) if cells else NO_CELLS
    np.testing.assert_array_equal(receiver.blocks[0].cells_v, expected_v)


async def test_samples_arrive_in_blocks_of_a_minute_and_the_rest_arrives_at_shutdown(
    receiver: Receiver, engine: NatsCluster, tmp_path: Path
) -> None:
    simulated = SimulatedEdge(receiver, tmp_path, url(engine))
    async with simulated.edge:
        simulated.add(30.5)
        await receiver.wait_for_samples(30 * 60)
        await until(lambda: simulated.edge.queue.position(PACK).oldest > 20)  # the worker has confirmed 20 blocks
    await simulated.assert_all_received()
    assert [block.number for block in receiver.blocks] == list(range(1, 32))
    assert {block.samples.size for block in receiver.blocks[:-1]} == {60}
    assert receiver.blocks[-1].arrival_s == WALL_S + simulated.now_s - 1.0
    assert (receiver.resends, receiver.gaps, simulated.edge.queue.dropped) == (0, 0, 0)


async def test_no_sample_is_lost_when_the_connection_is_cut(
    receiver: Receiver, engine: NatsCluster, tmp_path: Path
) -> None:
    async with Proxy(engine.mqtt_port) as network:
        simulated = SimulatedEdge(receiver, tmp_path, network.url)
        async with simulated.edge:
            simulated.add(5)
            await simulated.assert_all_received()
            for _ in range(3):
                network.disconnect_network()
                simulated.add(40)
                await until(lambda: not simulated.edge.queue.connected)
                network.rejects_connections = False
                simulated.add(1)
                await simulated.assert_all_received()
        assert simulated.edge.delivery.losses == 3


async def test_samples_keep_their_period_if_a_new_store_begins_later_than_the_wall_clock(
    receiver: Receiver, engine: NatsCluster, tmp_path: Path
) -> None:
    simulated = SimulatedEdge(receiver, tmp_path, "mqtt://127.0.0.1:9")  # no server listens at this port
    async with simulated.edge:
        simulated.add(2)
        # a worker that has received blocks of a later store makes the edge begin a store that is later still
        later = BlockRequest(store=int(WALL_S + 1e8) * 10**9, number=7, resend=False)
        await until(lambda: simulated.edge.queue.position(PACK).next_number == 2)  # the first block is on disk
        simulated.edge.queue.on_request(PACK, later)
        simulated.add(4)
        async with asyncio.timeout(LONG_S):
            first, second, third = [decode((await simulated.edge.queue.take(1))[0].message.payload) for _ in range(3)]
    assert (first.number, first.store_created_ns > later.store) == (1, True)
    assert (first.samples["time_s"] == 0.0).all()  # they were timestamped before the request
    assert second.samples["time_s"].tolist() == [*np.arange(60.0)]
    assert third.samples["time_s"].tolist() == [*np.arange(60.0, 120.0)]


@pytest.mark.thorough
async def test_no_sample_is_lost_when_the_server_is_killed(tmp_path: Path) -> None:
    with running(tmp_path, partitions=4) as engine:
        async with Receiver(engine.url, "pack") as receiver:
            simulated = SimulatedEdge(receiver, tmp_path, url(engine))
            async with simulated.edge:
                for kill in range(2):
                    simulated.add(200)
                    await receiver.wait_for_samples((205 * kill + 1) * 60)  # others are still on their way
                    await asyncio.to_thread(engine.kill, 0)
                    simulated.add(5)
                    await asyncio.to_thread(engine.start, 0)
                simulated.add(1)
                await simulated.assert_all_received()


async def test_blocks_lost_by_the_stream_are_sent_again(
    receiver: Receiver, engine: NatsCluster, tmp_path: Path
) -> None:
    """A leader may be killed after acknowledging messages that no other node has."""
    receiver.dropped_once = {5, 6, 14, 30}
    simulated = SimulatedEdge(receiver, tmp_path, url(engine))
    async with simulated.edge:
        simulated.add(40)
        await simulated.assert_all_received()
    assert receiver.dropped_once == set()  # each of the four was dropped
    assert receiver.gaps > 0


async def test_invalid_block_requests_are_counted_and_ignored(
    receiver: Receiver, engine: NatsCluster, tmp_path: Path
) -> None:
    simulated = SimulatedEdge(receiver, tmp_path, url(engine))
    async with simulated.edge:
        simulated.add(3)
        await simulated.assert_all_received()
        store = receiver.blocks[0].store_created_ns
        garbage = [b"", b"\xff\x00", b"{}", b'{"store": -1, "number": 1, "resend": false}', b"9" * 10_000, b"[" * 9_000]
        garbage += [f'{{"store": {n}, "number": {n}, "resend": true}}'.encode() for n in (10**30, 10**400)]
        for payload in garbage:
            await receiver.reply(payload)
        await receiver.reply(BlockRequest(store=1, number=1, resend=True))
        await receiver.reply(BlockRequest(store=store, number=1, resend=False))
        await until(lambda: simulated.edge.invalid_messages == len(garbage))
        simulated.add(3)
        await simulated.assert_all_received()


async def test_blocks_are_sent_to_any_mqtt_broker(broker: Broker, tmp_path: Path) -> None:
    """A receiver at an MQTT broker without NATS confirms blocks and requests resends."""
    edge = BlockSender(EdgeSettings(url=broker.url), "pack", tmp_path, final_send_timeout_s=LONG_S)
    async with Listener(broker, "raw/#") as listener, edge:
        samples = np.zeros(600, dtype=SAMPLE)
        samples["time_s"] = np.arange(600.0)
        edge.take(samples)
        await listener.wait("raw/pack", lambda data: decode(data).number == 9)
        store = decode(listener.all("raw/pack")[0]).store_created_ns
        message_count = len(listener.messages)
        await listener.publish(
            "edge/pack/awaits", BlockRequest(store=store, number=7, resend=True).model_dump_json(), qos=1
        )
        resent = decode(await listener.wait("raw/pack", skip=message_count))
        await listener.wait("raw/pack", lambda data: decode(data).number == 9, skip=message_count)
        assert (resent.number, resent.oldest) == (7, 7)
        await until(lambda: not edge.queue.waiting)  # the broker's acknowledgement may arrive later
        assert edge.health() == EdgeHealth(blocks_kept=3, blocks_unsent=0, blocks_dropped=0, trouble=None)


async def test_open_block_is_sent_if_the_source_falls_silent(
    receiver: Receiver, engine: NatsCluster, tmp_path: Path
) -> None:
    simulated = SimulatedEdge(receiver, tmp_path, url(engine), block_s=1.0)
    async with simulated.edge:
        simulated.add(1 / 60)  # one sample
        await receiver.wait_for_samples(1)


async def test_unreadable_password_file_is_a_user_error(engine: NatsCluster, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"^edge.password_file = /none: cannot be read"):
        BlockSender(EdgeSettings(username="a", password_file=Path("/none")), "pack", tmp_path)
