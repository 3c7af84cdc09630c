"""Increments of checkpoints: when they are written, on the real server, damaged, and restored by another worker."""

import itertools
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import pytest
from hypothesis import given, settings, strategies as st
from nats.aio.client import Client

from bms_estimator.fleet.nats.checkpoint_pointer import CheckpointPointer
from bms_estimator.fleet.worker.checkpoint.checkpoint_format import FORMAT, PartitionCheckpoint, read_checkpoint
from bms_estimator.fleet.worker.checkpoint.checkpoint_store import (
    CHECKPOINTS_PER_PARTITION,
    MAX_INCREMENT_FRACTION,
    MAX_INCREMENTS,
    CheckpointStore,
    open_checkpoints,
)
from bms_estimator.fleet.worker.partition import Partition
from tests.estimator.simulated_cell import pulses
from tests.fleet.checkpoints import DAY_S, Clock, damage, load, stored_objects
from tests.fleet.nats_cluster import NatsCluster
from tests.fleet.partition_stream import Stream, blocks_of, table

if TYPE_CHECKING:
    from bms_estimator.fleet.worker.checkpoint.claims import Claim

PACKS = tuple(f"p{n}" for n in range(20))
RECORD_BYTES = 60_000
"""Size of a pack's record, so that a header is much smaller than the records of all packs [bytes]."""
unused_partitions = itertools.count()
"""Numbers of unused partitions, one for each test."""
FEW, MANY = PACKS[:1], PACKS[:12]
"""Packs whose change is saved as an increment, and packs whose records exceed the maximum size of increments."""


@pytest.fixture
def cluster(module_cluster: NatsCluster) -> NatsCluster:
    return module_cluster


class Saves:
    """Successive checkpoints of one partition, whose records begin with the number of the save that changed them.

    Args:
        store: Checkpoints of the worker.
        partition: Number of the partition.
    """

    def __init__(self, store: CheckpointStore, partition: int) -> None:
        self.store, self._partition = store, partition
        self.stored_objects = partial(store._objects.names, partition)
        self.saved: list[PartitionCheckpoint] = []
        self.claim: Claim | None = None

    @property
    def pointer(self) -> CheckpointPointer:
        assert self.claim
        return self.claim.pointer

    async def save(self, changed: tuple[str, ...] | None, *, file_format: int = FORMAT) -> None:
        """Save a checkpoint after a change of packs; None: all were changed, and the worker does not know it."""
        self.claim = self.claim or await self.store.claim(self._partition)
        sequence = len(self.saved) + 1
        records = {pack: sequence.to_bytes(8) * (RECORD_BYTES // 8) for pack in changed or PACKS}
        before = self.saved[-1].packs if self.saved else {}
        self.saved.append(
            PartitionCheckpoint(
                self._partition, sequence, packs={**before, **records}, deferred={"unknown": (sequence, sequence)}
            )
        )
        self.claim = await self.store.write(
            self.claim, replace(self.saved[-1], changed=changed), file_format=file_format
        )

    async def loaded(self) -> list[PartitionCheckpoint]:
        """Claim the partition as another worker, and return the checkpoints that it reads, the newest first."""
        claim = await self.store.claim(self._partition)
        return [read_checkpoint(data) for data in await load(self.store, claim)]


@pytest.fixture
async def saves(nc: Client, clock: Clock) -> Saves:
    return Saves(await open_checkpoints(nc, "w"), next(unused_partitions))


async def test_saves_of_few_changed_packs_are_small_and_restore_all_packs(saves: Saves) -> None:
    await saves.save(None)
    for _ in range(3):
        await saves.save(FEW)
        assert (await saves.loaded())[0] == saves.saved[-1]
        saves.claim = await saves.store.claims.confirm(saves.claim)
    (last,) = saves.pointer.kept
    assert len(last.increments) == 3
    assert last.bytes > len(PACKS) * RECORD_BYTES
    assert 3 * RECORD_BYTES < last.increment_bytes < 3 * 2 * RECORD_BYTES


async def test_each_checkpoint_is_whole_if_all_packs_change(saves: Saves) -> None:
    for _ in range(4):
        await saves.save(PACKS)
    assert [each.increments for each in saves.pointer.kept] == [(), ()]
    assert await saves.loaded() == [saves.saved[3], saves.saved[2], saves.saved[0]]


async def test_number_and_size_of_the_objects_are_limited(saves: Saves) -> None:
    sizes, counts = [], []
    for number in range(2 * MAX_INCREMENTS):
        await saves.save(PACKS if number == 0 else FEW)
        counts.append(len(saves.pointer.objects))
        sizes.append(saves.pointer.kept[0].increment_bytes / saves.pointer.kept[0].bytes)
        assert await saves.stored_objects() == saves.pointer.objects
    assert max(counts) <= CHECKPOINTS_PER_PARTITION * (1 + MAX_INCREMENTS) + 1
    header_fraction = 0.1  # only the records are counted before an increment is written
    assert 0.3 < max(sizes) < MAX_INCREMENT_FRACTION + header_fraction
    assert (await saves.loaded())[0] == saves.saved[-1]


async def test_number_of_increments_is_limited_although_no_record_is_changed(saves: Saves) -> None:
    await saves.save(None)
    for _ in range(MAX_INCREMENTS + 1):
        saves.saved.append(replace(saves.saved[-1], sequence=saves.saved[-1].sequence + 1))
        saves.claim = await saves.store.write(saves.claim, replace(saves.saved[-1], changed=()), file_format=FORMAT)
    assert [len(each.increments) for each in saves.pointer.kept] == [0, MAX_INCREMENTS]


async def test_large_changes_and_the_first_checkpoint_of_a_day_are_whole(saves: Saves, clock: Clock) -> None:
    for changed, days in ((None, 0), (FEW, 0), (MANY, 0), (FEW, 0), (FEW, 1), (FEW, 0)):
        clock.now_s += days * DAY_S
        await saves.save(changed)
    assert [len(each.increments) for each in saves.pointer.kept] == [1, 1]
    assert [each.increments for each in saves.pointer.daily] == [(), ()]
    expected = [saves.saved[index] for index in (5, 3, 4, 0)]  # the last two, and the whole ones of two days
    assert await saves.loaded() == expected


@pytest.mark.parametrize(
    ("first_format", "second_format"), [(FORMAT - 1, FORMAT - 1), (FORMAT - 1, FORMAT), (FORMAT, FORMAT - 1)]
)
async def test_checkpoint_beside_one_of_the_previous_format_is_whole(
    saves: Saves, first_format: int, second_format: int
) -> None:
    await saves.save(None, file_format=first_format)
    await saves.save(FEW, file_format=second_format)
    assert [(each.format, each.increments) for each in saves.pointer.kept] == [(second_format, ()), (first_format, ())]
    assert (await saves.loaded())[0] == saves.saved[1]


async def test_damaged_increment_costs_only_the_saves_from_it_on(nc: Client, saves: Saves) -> None:
    await saves.save(None)
    for _ in range(3):
        await saves.save(FEW)
    await damage(nc, saves.pointer.kept[0].increments[1])
    assert (await saves.loaded())[0] == saves.saved[1]
    saves.claim = None
    await saves.save(None)
    await damage(nc, saves.pointer.kept[0].object)
    assert (await saves.loaded())[0] == saves.saved[1]  # the previous checkpoint was not replaced


async def test_damaged_whole_checkpoint_does_not_replace_the_previous_one(nc: Client, saves: Saves) -> None:
    for changed in (None, FEW, None, FEW):
        await saves.save(changed)
    await damage(nc, saves.pointer.kept[0].object)
    assert (await saves.loaded())[0] == saves.saved[1]
    saves.claim = None
    await saves.save(None)
    assert await saves.loaded() == [saves.saved[4], saves.saved[1], saves.saved[0]]
    assert saves.store._damaged.isdisjoint(await stored_objects(nc))


@settings(max_examples=20, deadline=None)
@given(st.lists(st.tuples(st.sampled_from("abcd"), st.booleans()), max_size=30))
def test_states_of_increments_are_bit_identical_after_any_order_of_blocks_and_saves(steps) -> None:
    """Restore the concatenated increments after each save."""
    blocks = blocks_of(pulses(soc=0.6, hours=0.2)[0])
    stream, numbers = Stream(Partition(5, table)), dict.fromkeys("abcd", 0)
    data, increments = b"".join(stream.partition.snapshot().chunks()), 0
    stream.partition.mark_saved(is_whole=True)
    for pack, is_saved in steps:
        stream.send(pack, blocks[numbers[pack]])
        numbers[pack] += 1
        if is_saved:
            snapshot = stream.partition.snapshot()
            increments += 1
            data += b"".join(snapshot.to_increment(increments).chunks())
            stream.partition.mark_saved(is_whole=False)
            assert read_checkpoint(data) == snapshot
    restored = Partition.restore(5, table, data)
    for sequence, (pack, message) in enumerate(stream.messages, 1):
        restored.process(pack, message, sequence)
    assert restored.snapshot().packs == stream.partition.snapshot().packs
