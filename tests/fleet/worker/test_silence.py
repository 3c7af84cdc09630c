"""Partitions without messages: messages of a dead worker, a partition with another owner meanwhile, and a block
with an internal error."""

import asyncio
from pathlib import Path

import nats
from nats.aio.client import Client
from nats.aio.msg import Msg
from structlog.testing import capture_logs

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.streams import make_streams
from bms_estimator.fleet.worker.checkpoint_store import CheckpointStore
from bms_estimator.fleet.worker.partition import Table
from bms_estimator.fleet.worker.partition_lease import PartitionLease
from bms_estimator.fleet.worker.pinned_consumer import PinnedConsumer
from bms_estimator.fleet.worker.worker import Options, work
from tests.fleet.engine import running
from tests.fleet.workers import Heartbeats, block, end_states, estimated, know, send, until
from tests.patience import end

PARTITIONS = 4
PACKS = ["p1", "p2", "p3"]
BLOCKS = 3


async def test_what_a_dead_worker_was_given_is_taken_though_nobody_sends_more(tmp_path: Path) -> None:
    with running(tmp_path, partitions=PARTITIONS) as engine:
        nc = await nats.connect(engine.url)
        await make_streams(nc, partitions=PARTITIONS)
        known = await know(nc, PACKS)
        used = {subjects.partition_of(pack, PARTITIONS) for pack in PACKS}
        assert 0 < len(used) < PARTITIONS
        for number in range(1, BLOCKS):
            for pack in PACKS:
                await send(nc, pack, block(pack, number))
        for number in used:
            await _be_given(nc, number, (BLOCKS - 1) * _packs_of(number))
        stop = asyncio.Event()
        working = asyncio.create_task(work(Options(engine.url, "w"), stop))
        async with Heartbeats(nc) as heard:
            await heard.until_held(PARTITIONS, "w")
            await heard.until(lambda last: last["w"].blocks >= (BLOCKS - 1) * len(PACKS))
            for pack in PACKS:
                await send(nc, pack, block(pack, BLOCKS))
            await heard.until(lambda last: last["w"].blocks >= BLOCKS * len(PACKS))
        stop.set()
        await working
        states = await end_states(nc, known, PARTITIONS)
        for pack in PACKS:
            partition = states[subjects.partition_of(pack, PARTITIONS)]
            state = partition.state(pack)
            assert state is not None
            assert state["estimator"].tobytes() == estimated(known, pack, BLOCKS)
            assert partition.counters["blocks"] == BLOCKS * _packs_of(partition.number)
        await nc.close()


async def test_a_fault_of_ours_costs_its_block_and_is_counted(tmp_path: Path) -> None:
    with running(tmp_path, partitions=1) as engine:
        nc = await nats.connect(engine.url)
        await make_streams(nc, partitions=1)
        known = await know(nc, PACKS)

        def table(pack: str):
            return known(pack) if pack != "p1" else {}[pack]

        holding, taking = await _holding_first_blocks(nc, table)
        assert holding.faults == 1
        assert holding.partition
        assert holding.partition.counters["blocks"] == len(PACKS) - 1
        await end(taking)
        await nc.close()


async def test_who_was_fenced_out_and_is_given_the_partition_again_says_so_and_begins_from_what_is_kept(
    tmp_path: Path,
) -> None:
    with running(tmp_path, partitions=1) as engine:
        nc = await nats.connect(engine.url)
        await make_streams(nc, partitions=1)
        known = await know(nc, PACKS)
        holding, taking = await _holding_first_blocks(nc, known)
        await (await _keeping(nc, "other")).claim(0)  # and dies: its pin has lapsed when we ask for more

        def said() -> object:
            holding.check_silence()
            return any(line["event"].startswith("fenced out") and line["worker"] == "other" for line in logs)

        with capture_logs() as logs:
            await until(said, lambda: logs)
            await until(lambda: holding.blocks >= 2 * len(PACKS), lambda: holding.blocks)
        assert holding.partition
        assert holding.partition.counters["blocks"] == len(PACKS)
        for pack in PACKS:
            state = holding.partition.state(pack)
            assert state is not None
            assert state["estimator"].tobytes() == estimated(known, pack, 1)
        await end(taking)
        await nc.close()


def _packs_of(partition: int) -> int:
    return sum(subjects.partition_of(pack, PARTITIONS) == partition for pack in PACKS)


async def _holding_first_blocks(nc: Client, table: Table) -> tuple[PartitionLease, asyncio.Task[None]]:
    """Run a worker's only partition once it has stepped the first block of each pack."""
    inbox = nc.new_inbox()
    holding = PartitionLease(
        nc, 0, table, await _keeping(nc, "w"), inbox, asyncio.Lock(), partitions=1, is_busy=lambda: False
    )
    await _subscribe(nc, f"{inbox}.0.*", holding.receive)
    taking = asyncio.create_task(holding.run())
    for pack in PACKS:
        await send(nc, pack, block(pack, 1))
    await holding.consumer.renew()
    await until(lambda: holding.blocks >= len(PACKS), lambda: holding.blocks)
    return holding, taking


async def _be_given(nc: Client, partition: int, messages: int) -> None:
    """Be a worker that has all messages of a partition, and dies."""
    inbox = nc.new_inbox()
    consumer = PinnedConsumer(nc, partition, inbox)
    await _subscribe(nc, f"{inbox}.*", consumer.receive)
    await consumer.renew()
    await until(lambda: len(consumer.waiting) == messages, lambda: len(consumer.waiting))
    assert consumer.pinned


async def _subscribe(nc: Client, subject: str, receive) -> None:
    async def received(message: Msg) -> None:
        receive(message)

    await nc.subscribe(subject, cb=received)


async def _keeping(nc: Client, worker: str) -> CheckpointStore:
    js = nc.jetstream()
    states = await js.object_store(subjects.STATES_BUCKET)
    return CheckpointStore(nc, worker, await js.key_value(subjects.CHECKPOINTS_BUCKET), states)
