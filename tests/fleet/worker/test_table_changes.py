"""Changes of the table of packs in the order of the stream: a takeover meets old blocks with old rows."""

import asyncio
from pathlib import Path

import numpy as np
import pytest
from nats.aio.client import Client
from nats.js.errors import NotFoundError

from bms_estimator.edge import subjects
from bms_estimator.fleet.packs.pack_bucket import write_bucket
from bms_estimator.fleet.packs.pack_registry import PackRegistry
from bms_estimator.fleet.packs.pack_row import PackSpec, encode_row
from bms_estimator.fleet.packs.table_change import PackSource, decode_change, encode_change
from bms_estimator.fleet.worker.partition import Partition
from bms_estimator.fleet.worker.worker import Options, work
from tests.fleet.nats_cluster import NatsCluster
from tests.fleet.workers import PACK_ROW, PERIOD_S, Heartbeats, Process, block, end_states, load_packs, send

CHANGED_ROW = encode_row(PackSpec(cell="ncr18650", period_s=PERIOD_S, capacity_ah=2.5))
BLOCKS = 3
"""Number of blocks; the row changes before the last one."""


def registry_of(row: bytes) -> PackRegistry:
    """Return a table in which pack ``p1`` has a row."""
    registry = PackRegistry()
    registry.set_row("p1", row)
    return registry


def partition_of(registry: PackRegistry, checkpoint: bytes | None = None) -> Partition:
    """Return a new partition, or the one of a checkpoint."""
    if checkpoint is None:
        return Partition(0, registry, sources=registry)
    return Partition.restore(0, registry, checkpoint, sources=registry)


def estimator_state(partition: Partition) -> bytes:
    """Return the estimator's record of pack ``p1``."""
    state = partition.state("p1")
    assert state is not None
    return np.ascontiguousarray(state["estimator"]).tobytes()


@pytest.fixture(scope="module")
def messages() -> list[bytes]:
    """Return two blocks, a change of the row, and a block."""
    registry = registry_of(PACK_ROW)
    partition = partition_of(registry)
    partition.process("p1", block("p1", 1), 1)
    registry.set_row("p1", CHANGED_ROW)
    change = partition.in_force.table_change("p1")
    assert change is not None
    return [block("p1", 1), block("p1", 2), change, block("p1", 3)]


@pytest.fixture(scope="module")
def expected(messages: list[bytes]) -> bytes:
    """Return the state after all messages in one run."""
    registry = registry_of(PACK_ROW)
    partition = partition_of(registry)
    for sequence, message in enumerate(messages, 1):
        partition.process("p1", message, sequence)
    return estimator_state(partition)


@pytest.mark.parametrize("taken_over_after", [1, 2, 3])
def test_state_after_a_takeover_does_not_depend_on_the_present_table(
    messages: list[bytes], expected: bytes, taken_over_after: int
) -> None:
    partition = partition_of(registry_of(PACK_ROW))
    for sequence, message in enumerate(messages[:taken_over_after], 1):
        partition.process("p1", message, sequence)
    successor = partition_of(registry_of(CHANGED_ROW), b"".join(partition.snapshot().chunks()))
    for sequence, message in enumerate(messages[taken_over_after:], taken_over_after + 1):
        successor.process("p1", message, sequence)
    assert estimator_state(successor) == expected
    assert successor.counters["table_changes"] == 1


def test_changed_row_takes_effect_at_its_message_and_not_before(messages: list[bytes], expected: bytes) -> None:
    registry = registry_of(PACK_ROW)
    partition = partition_of(registry)
    partition.process("p1", messages[0], 1)
    registry.set_row("p1", CHANGED_ROW)
    for sequence, message in enumerate(messages[1:], 2):
        partition.process("p1", message, sequence)
    assert estimator_state(partition) == expected
    assert partition.in_force.table_change("p1") is None  # it is in force


@pytest.mark.parametrize("saved_after", [1, 2, 3])
def test_change_between_deferred_blocks_takes_effect_between_them(
    messages: list[bytes], expected: bytes, saved_after: int
) -> None:
    partition = partition_of(registry_of(PACK_ROW))
    for sequence in range(1, len(messages) + 1):
        partition.defer("p1", sequence)
    for sequence, message in enumerate(messages[:saved_after], 1):
        partition.process_deferred("p1", message, sequence)
    successor = partition_of(registry_of(CHANGED_ROW), b"".join(partition.snapshot().chunks()))
    for sequence, message in enumerate(messages[saved_after:], saved_after + 1):
        successor.process_deferred("p1", message, sequence)
    assert estimator_state(successor) == expected
    assert not successor.deferred


def test_removed_pack_is_unknown_from_its_message_on() -> None:
    registry = registry_of(PACK_ROW)
    partition = partition_of(registry)
    partition.process("p1", block("p1", 1), 1)
    registry.set_row("p1", None)
    change = partition.in_force.table_change("p1")
    assert change is not None
    assert decode_change(change) is None
    assert partition.in_force.is_known("p1")
    partition.process("p1", change, 2)
    partition.process("p1", block("p1", 2), 3)
    assert partition.unknown == ("p1",)


@pytest.mark.parametrize("damaged", [b"BMST", b"BMST{", b'BMST{"row": 1}', b"BMST[]"])
def test_damaged_change_is_counted_and_skipped(damaged: bytes) -> None:
    partition = partition_of(registry_of(PACK_ROW))
    partition.process("p1", damaged, 1)
    assert (partition.sequence, partition.counters["damaged"]) == (1, 1)


@pytest.mark.thorough
async def test_successor_of_a_killed_worker_applies_a_changed_row_between_the_same_blocks(
    nc: Client, cluster: NatsCluster, tmp_path: Path
) -> None:
    await load_packs(nc, ["p1"])
    async with Heartbeats(nc) as heartbeats:
        await send(nc, "p1", block("p1", 1))
        first = Process(tmp_path, cluster.url, "first")
        await heartbeats.until(lambda last: "first" in last and last["first"].blocks == 1)
        assert await first.end() == 0  # its checkpoint includes block 1
        second = Process(tmp_path, cluster.url, "second")
        await send(nc, "p1", block("p1", 2))
        await heartbeats.until(lambda last: "second" in last and last["second"].blocks == 1)
        await write_bucket(nc, subjects.PACKS_BUCKET, {"p1": CHANGED_ROW})
        await heartbeats.until(lambda last: last["second"].counters.get("table_changes") == 1)
        await send(nc, "p1", block("p1", BLOCKS))
        await heartbeats.until(lambda last: last["second"].blocks == BLOCKS - 1)
        second.kill()
        third = Process(tmp_path, cluster.url, "third")
        await heartbeats.until(lambda last: "third" in last and last["third"].blocks == BLOCKS - 1)
        assert await third.end() == 0
    registry = registry_of(PACK_ROW)
    reference = partition_of(registry)
    for sequence in range(1, BLOCKS + 2):
        reference.process("p1", await message_of(nc, sequence), sequence)
    restored = (await end_states(nc, registry, 1))[0]
    assert estimator_state(restored) == estimator_state(reference)
    assert restored.counters["table_changes"] == 1
    with pytest.raises(NotFoundError):  # no change was sent twice
        await message_of(nc, BLOCKS + 2)


async def test_change_that_an_edge_sends_as_a_block_has_no_effect(nc: Client, cluster: NatsCluster) -> None:
    await load_packs(nc, ["p1"])
    stop = asyncio.Event()
    async with Heartbeats(nc) as heartbeats:
        worker_task = asyncio.create_task(work(Options(cluster.url, "w"), stop))
        await send(nc, "p1", block("p1", 1))
        await send(nc, "p1", encode_change(PackSource(CHANGED_ROW.decode(), None)))
        await heartbeats.until(lambda last: "w" in last and last["w"].counters.get("damaged") == 1)
        assert "table_changes" not in heartbeats.last["w"].counters
        stop.set()
        await worker_task


async def test_change_that_the_table_has_withdrawn_before_it_was_applied_is_followed_by_the_present_row(
    nc: Client,
    cluster: NatsCluster,
) -> None:
    await load_packs(nc, ["p1"])
    stop = asyncio.Event()
    async with Heartbeats(nc) as heartbeats:
        worker_task = asyncio.create_task(work(Options(cluster.url, "w"), stop))
        await send(nc, "p1", block("p1", 1))
        await heartbeats.until(lambda last: "w" in last and last["w"].blocks == 1)
        # as sent by a worker while the table had this row, and then deferred or read by the next owner
        change = encode_change(PackSource(CHANGED_ROW.decode(), None))
        await nc.jetstream().publish(subjects.table_change("p1"), change)
        await heartbeats.until(lambda last: last["w"].counters.get("table_changes") == 2)
        stop.set()
        await worker_task
    restored = (await end_states(nc, registry_of(PACK_ROW), 1))[0]
    assert restored.in_force.rows == {"p1": PackSource(PACK_ROW.decode(), None)}


async def message_of(nc: Client, sequence: int) -> bytes:
    """Return a message of the stream of blocks."""
    return (await nc.jetstream().get_msg(subjects.RAW_STREAM, sequence)).data or b""
