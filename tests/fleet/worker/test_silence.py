"""Partition lease after the death of other workers, another owner, or an internal error."""

import asyncio
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path

import nats
from nats.aio.client import Client
from nats.aio.msg import Msg
from structlog.testing import capture_logs

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.streams import make_streams
from bms_estimator.fleet.worker.block_loop import BlockLoop
from bms_estimator.fleet.worker.block_runner import Totals
from bms_estimator.fleet.worker.checkpoint.checkpoint_format import FORMAT
from bms_estimator.fleet.worker.checkpoint.checkpoint_store import open_checkpoints
from bms_estimator.fleet.worker.partition_lease import PartitionLease
from bms_estimator.fleet.worker.pinned_consumer import PinnedConsumer
from bms_estimator.fleet.worker.table_in_force import PackLookup
from bms_estimator.fleet.worker.takeover import GUARDED_CLAIMS
from bms_estimator.fleet.worker.worker import Options, work
from bms_estimator.process.runtime import end_tasks, until_first_ends
from tests.fleet.nats_cluster import running
from tests.fleet.partition_stream import estimates_of
from tests.fleet.workers import Heartbeats, block, end_states, estimated, load_packs, send, until
from tests.patience import LONG_S

PARTITIONS = 4
PACKS = ["p1", "p2", "p3"]
DEFERRED_BLOCKS = 40
"""Number of deferred blocks of a pack that becomes known."""
BLOCKS = 3
"""Number of blocks of each pack."""
REPLAYED_BLOCKS = 50
"""Number of blocks of each pack in a guarded replay."""


async def test_messages_delivered_to_a_dead_worker_are_processed_without_further_blocks(tmp_path: Path) -> None:
    with running(tmp_path, partitions=PARTITIONS) as cluster:
        nc = await nats.connect(cluster.url)
        await make_streams(nc, partitions=PARTITIONS)
        registry = await load_packs(nc, PACKS)
        used_partitions = {subjects.partition_of(pack, PARTITIONS) for pack in PACKS}
        assert 0 < len(used_partitions) < PARTITIONS
        for number in range(1, BLOCKS):
            for pack in PACKS:
                await send(nc, pack, block(pack, number))
        for number in used_partitions:
            await _receive_and_die(nc, number, (BLOCKS - 1) * _pack_count(number))
        stop = asyncio.Event()
        worker_task = asyncio.create_task(work(Options(cluster.url, "w"), stop))
        async with Heartbeats(nc) as heartbeats:
            await heartbeats.until_held(PARTITIONS, "w")
            await heartbeats.until(lambda last: last["w"].blocks >= (BLOCKS - 1) * len(PACKS))
            for pack in PACKS:
                await send(nc, pack, block(pack, BLOCKS))
            await heartbeats.until(lambda last: last["w"].blocks >= BLOCKS * len(PACKS))
        stop.set()
        await worker_task
        states = await end_states(nc, registry, PARTITIONS)
        for pack in PACKS:
            partition = states[subjects.partition_of(pack, PARTITIONS)]
            state = partition.state(pack)
            assert state is not None
            assert estimates_of(state["estimator"]) == estimated(registry, pack, BLOCKS)
            assert partition.counters["blocks"] == BLOCKS * _pack_count(partition.number)
        await nc.close()


async def test_block_with_an_internal_error_is_skipped_and_counted_as_a_fault(nc: Client) -> None:
    registry = await load_packs(nc, PACKS)

    def table(pack: str):
        if pack == "p1":
            raise KeyError(pack)  # as by a bug
        return registry(pack)

    async with _running_lease(nc, table, 1) as lease:
        await until(lambda: lease.totals.blocks >= len(PACKS), lambda: lease.totals.blocks)
        assert lease.totals.faults == 1
        assert lease.partition
        assert lease.partition.counters["blocks"] == len(PACKS) - 1


async def test_guarded_replay_reads_each_message_from_the_stream_once(nc: Client) -> None:
    registry, blocks = await load_packs(nc, PACKS), REPLAYED_BLOCKS * len(PACKS)
    await _claim_without_checkpoint(nc, GUARDED_CLAIMS)
    async with _running_lease(nc, registry, REPLAYED_BLOCKS) as lease:
        received = nc.stats["in_msgs"]
        await until(lambda: lease.totals.blocks == blocks, lambda: lease.totals.blocks)
        # each message is delivered and read
        assert nc.stats["in_msgs"] - received < 3 * blocks


async def test_guarded_replay_ends_when_another_worker_claims_the_partition(nc: Client) -> None:
    registry, blocks = await load_packs(nc, PACKS), REPLAYED_BLOCKS * len(PACKS)
    await _claim_without_checkpoint(nc, GUARDED_CLAIMS)
    async with _running_lease(nc, registry, REPLAYED_BLOCKS) as lease:
        await until(lambda: lease.totals.blocks, lambda: lease.totals.blocks)
        await _claim_without_checkpoint(nc, 1)
        await lease.save()
        assert not lease.is_owned
        dropped = lease.totals.blocks + 1  # one more is being processed
        await until(lambda: lease.partition and lease.partition.sequence == blocks, lambda: lease.totals.blocks)
        assert lease.totals.blocks <= dropped + blocks


async def test_worker_that_lost_its_partition_and_owns_it_again_continues_from_the_checkpoint(nc: Client) -> None:
    registry = await load_packs(nc, PACKS)
    async with _running_lease(nc, registry, 1) as lease:
        await until(lambda: lease.totals.blocks >= len(PACKS), lambda: lease.totals.blocks)
        # another worker claims the partition and dies, so that its pin lapses
        await _claim_without_checkpoint(nc, 1)

        def is_fenced() -> object:
            lease.check_silence()
            return any(line["event"].startswith("fenced out") and line["worker"] == "other" for line in logs)

        with capture_logs() as logs:
            await until(is_fenced, lambda: logs)
            # the checkpoint has no block yet, so that the first block of each pack is processed again
            await until(lambda: lease.totals.blocks >= 2 * len(PACKS), lambda: lease.totals.blocks)
        assert lease.partition
        assert lease.partition.counters["blocks"] == len(PACKS)
        for pack in PACKS:
            state = lease.partition.state(pack)
            assert state is not None
            assert estimates_of(state["estimator"]) == estimated(registry, pack, 1)


async def test_block_of_another_pack_is_processed_before_the_deferred_blocks_of_a_pack_that_became_known(
    nc: Client,
) -> None:
    registry, late, other = await load_packs(nc, PACKS), PACKS[0], PACKS[1]
    known = {pack: registry(pack) for pack in PACKS if pack != late}
    async with _running_lease(nc, known.get, DEFERRED_BLOCKS) as lease:
        messages = DEFERRED_BLOCKS * len(PACKS)
        await until(lambda: lease.partition and lease.partition.sequence == messages, lambda: lease.totals)
        states = await nc.subscribe(subjects.published("*", "state"))
        known[late] = registry(late)
        lease.on_settings_changed(late)
        await send(nc, other, block(other, DEFERRED_BLOCKS + 1))
        packs = [(await states.next_msg(LONG_S)).subject for _ in range(DEFERRED_BLOCKS + 1)]
        assert packs.index(subjects.published(other, "state")) < DEFERRED_BLOCKS


def _pack_count(partition: int) -> int:
    """Return the number of packs in a partition."""
    return sum(subjects.partition_of(pack, PARTITIONS) == partition for pack in PACKS)


@asynccontextmanager
async def _running_lease(nc: Client, table: PackLookup, blocks: int) -> AsyncGenerator[PartitionLease, None]:
    """Run a lease of the only partition, whose stream has ``blocks`` blocks of each pack."""
    for number in range(1, blocks + 1):
        for pack in PACKS:
            await send(nc, pack, block(pack, number))
    inbox, block_loop = nc.new_inbox(), BlockLoop()
    lease = PartitionLease(
        nc,
        0,
        table,
        await open_checkpoints(nc, "w"),
        inbox,
        block_loop,
        Totals(),
        partitions=1,
        checkpoint_format=lambda: FORMAT,
        is_busy=lambda: False,
    )
    await _subscribe(nc, f"{inbox}.0.*", lease.receive)
    running_lease = asyncio.create_task(until_first_ends(lease.run(), block_loop.run()))
    await lease.consumer.renew()
    try:
        yield lease
    finally:
        await end_tasks(running_lease)


async def _claim_without_checkpoint(nc: Client, claims: int) -> None:
    """Claim the only partition as workers that die before their first checkpoint."""
    store = await open_checkpoints(nc, "other")
    for _ in range(claims):
        await store.claim(0)


async def _receive_and_die(nc: Client, partition: int, messages: int) -> None:
    """Receive all messages of a partition and acknowledge none, as a worker that dies."""
    inbox = nc.new_inbox()
    consumer = PinnedConsumer(nc, partition, inbox)
    await _subscribe(nc, f"{inbox}.*", consumer.receive)
    await consumer.renew()
    await until(lambda: len(consumer.waiting) == messages, lambda: len(consumer.waiting))
    assert consumer.has_pin


async def _subscribe(nc: Client, subject: str, receive) -> None:
    """Call ``receive`` with each message of a subject."""

    async def on_message(message: Msg) -> None:
        receive(message)

    await nc.subscribe(subject, cb=on_message)
