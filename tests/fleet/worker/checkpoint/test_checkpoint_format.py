"""Format of checkpoints: intact, damaged, and written by another version."""

import json
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, strategies as st

from bms_estimator.fleet.packs.table_change import PackSource
from bms_estimator.fleet.worker import pack_records
from bms_estimator.fleet.worker.block_order import MAX_EARLY_REPEATS
from bms_estimator.fleet.worker.checkpoint import checkpoint_format
from bms_estimator.fleet.worker.checkpoint.checkpoint_format import (
    CHUNK_BYTES,
    FORMAT,
    CheckpointError,
    PartitionCheckpoint,
    UnreadableFormatError,
    common_format,
    read_checkpoint,
)
from bms_estimator.fleet.worker.deferred import Span
from bms_estimator.fleet.worker.pack_records import (
    CURRENT_LAYOUT,
    RecordWithLayout,
    dtype_of,
    layout_of,
)
from bms_estimator.fleet.worker.pack_state import PACK_STATE, UnpackedRecord
from bms_estimator.fleet.worker.partition import Partition
from bms_estimator.model.payloads.estimate import Estimate
from tests.estimator.simulated_cell import pulses
from tests.fleet.partition_stream import SAMPLES, Stream, blocks_of, deliver, table
from tests.fleet.worker import later_version
from tests.fleet.worker.later_version import DOWNGRADED, UPGRADED

names = st.text(max_size=10)
snapshots = st.builds(
    PartitionCheckpoint,
    st.integers(0, 63),
    st.integers(0, 2**63),
    st.dictionaries(names, st.integers(0)),
    st.dictionaries(names, st.binary(max_size=40)),
    st.dictionaries(
        names, st.builds(RecordWithLayout, st.just(layout_of(np.dtype([("x", "<f8", (2,))]))), st.binary(max_size=9))
    ),
    st.dictionaries(names, st.builds(Span, st.integers(0, 2**63), st.integers(0, 2**63))),
    st.dictionaries(names, st.builds(PackSource, names, st.none() | names)),
)


def to_bytes(snapshot: PartitionCheckpoint) -> bytes:
    """Return the encoded checkpoint."""
    return b"".join(snapshot.chunks())


@given(snapshots)
def test_checkpoint_is_read_as_it_was_written(snapshot: PartitionCheckpoint) -> None:
    assert read_checkpoint(to_bytes(snapshot)) == snapshot


@given(snapshots, snapshots, st.data())
def test_increments_replace_the_records_of_the_changed_packs(before, after, data) -> None:
    after = replace(after, packs={**before.packs, **after.packs}, other_layouts={})
    changed = {pack for pack, packed in after.packs.items() if before.packs.get(pack) != packed}
    unchanged = data.draw(st.sets(st.sampled_from([*after.packs, "another"])))
    increment = replace(after, changed=changed | unchanged | before.other_layouts.keys()).to_increment(1)
    expected = replace(after, other_layouts={p: s for p, s in before.other_layouts.items() if p not in after.packs})
    assert increment.packs.keys() >= changed
    assert read_checkpoint(to_bytes(replace(before, increment=0)) + to_bytes(increment)) == expected


def test_checkpoint_with_a_missing_increment_or_without_the_whole_one_is_rejected() -> None:
    whole = PartitionCheckpoint(0, 1, packs={"a": b"12345678"}, changed={"a"})
    first, second = (to_bytes(whole.to_increment(number)) for number in (1, 2))
    assert read_checkpoint(to_bytes(whole) + first + second) == whole
    for parts in ((first,), (first, second), (to_bytes(whole), second), (to_bytes(whole), first, first)):
        with pytest.raises(CheckpointError, match="damaged"):
            read_checkpoint(b"".join(parts))


def test_checkpoint_of_many_packs_is_split_into_chunks() -> None:
    packs = {f"pack{n}": bytes([n % 256]) * 1000 for n in range(3000)}
    snapshot = PartitionCheckpoint(0, 9, packs=packs)
    chunks = list(snapshot.chunks())
    assert len(chunks) == 3
    assert max(map(len, chunks)) < CHUNK_BYTES + 12_000
    assert read_checkpoint(b"".join(chunks)) == snapshot


@given(snapshots, st.data())
def test_damaged_checkpoint_raises_checkpoint_error(snapshot: PartitionCheckpoint, data) -> None:
    intact = to_bytes(snapshot)
    damaged = bytearray(intact)
    position = data.draw(st.integers(0, len(intact) - 1))
    change = data.draw(st.sampled_from(["flip a bit", "cut the end", "append", "drop bytes"]))
    if change == "flip a bit":
        damaged[position] ^= 1 << data.draw(st.integers(0, 7))
    elif change == "cut the end":
        del damaged[position:]
    elif change == "drop bytes":
        del damaged[position : position + data.draw(st.integers(1, 20))]
    else:
        damaged += data.draw(st.binary(min_size=1))
    with pytest.raises(CheckpointError):
        read_checkpoint(bytes(damaged))


def test_each_single_changed_byte_is_detected() -> None:
    intact = to_bytes(PartitionCheckpoint(3, 7, {"blocks": 1}, {"a": b"12345678"}, deferred={"b": Span(5, 7)}))
    for position in range(len(intact)):
        with pytest.raises(CheckpointError):
            read_checkpoint(intact[:position] + bytes([intact[position] ^ 1]) + intact[position + 1 :])


@pytest.mark.parametrize("data", [b"", b"BMSFLEET", b"x" * 100])
def test_bytes_that_are_no_checkpoint_are_rejected(data: bytes) -> None:
    with pytest.raises(CheckpointError, match="checkpoint"):
        Partition.restore(0, table, data)


def test_checkpoint_of_another_partition_is_rejected() -> None:
    with pytest.raises(CheckpointError, match="of partition 3, not of 4"):
        Partition.restore(4, table, to_bytes(PartitionCheckpoint(3, 0)))


@pytest.fixture
def later_format(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """Set the next format as the newest one, which the migrations of ``later_version`` convert."""
    with monkeypatch.context() as patched:
        later_version.set_format(checkpoint_format.FORMAT + 1, patched.setattr)
        yield checkpoint_format.FORMAT


def test_previous_format_is_upgraded_when_it_is_read_and_downgraded_when_it_is_written(later_format: int) -> None:
    snapshot = PartitionCheckpoint(3, 7, packs={"a": b"12345678"})
    previous = b"".join(snapshot.chunks(later_format - 1))
    assert read_checkpoint(previous) == replace(snapshot, counters={UPGRADED: 1, DOWNGRADED: 1})
    assert read_checkpoint(to_bytes(snapshot)) == snapshot


def test_error_of_an_unreadable_format_names_both_formats_and_a_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patched:
        later_version.set_format(checkpoint_format.FORMAT + 2, patched.setattr)
        later = to_bytes(PartitionCheckpoint(3, 0))
    with pytest.raises(UnreadableFormatError, match=r"is of format 5, this version reads 2 and 3: start a worker"):
        read_checkpoint(later)


def test_whole_checkpoint_is_equal_in_the_previous_format() -> None:
    snapshot = PartitionCheckpoint(3, 7, packs={"a": b"12345678"}, in_force={"a": PackSource("{}", None)})
    assert read_checkpoint(b"".join(snapshot.chunks(FORMAT - 1))) == snapshot


def test_all_live_workers_can_read_the_common_format_as_far_as_this_version_writes_it(later_format: int) -> None:
    assert common_format([]) == later_format
    assert common_format([later_format + 1, later_format - 1]) == later_format - 1
    assert common_format([later_format - 2]) == later_format - 1


def test_layout_is_restored_to_the_dtype_of_a_pack_state() -> None:
    dtype = dtype_of(CURRENT_LAYOUT)
    assert layout_of(dtype) == CURRENT_LAYOUT
    assert dtype == PACK_STATE


@pytest.mark.parametrize("layout", ["", "7", "[1]", '[["a","f8"]]', '[["a","O",[]]]', '[["a","<f8",[99999999]]]'])
def test_invalid_layout_is_rejected(layout: str) -> None:
    with pytest.raises(ValueError, match=r".+"):
        dtype_of(layout)


@pytest.fixture(scope="module")
def samples():
    return pulses(soc=0.9, hours=1.0)[0]


def test_state_is_bit_identical_after_an_upgrade_that_changed_no_field_of_the_estimator(samples) -> None:
    stream, blocks = Stream(Partition(5, table)), blocks_of(samples)
    deliver(stream, "a", blocks[:100])
    state = stream.partition.state("a")
    layout = [part for part in json.loads(CURRENT_LAYOUT) if part[0] != "cells"]
    delivery = next(fields for name, fields, _ in layout if name == "delivery")
    delivery[:] = [field for field in delivery if field[0] != "clock_error_s"]
    previous = UnpackedRecord(np.dtype(pack_records._dtype_fields(layout)))
    for part in previous.record.dtype.names:
        for name in previous.record.dtype[part].names:
            previous.record[part][name] = state[part][name]
    previous_record = RecordWithLayout(layout_of(previous.record.dtype), previous.packed_bytes())
    snapshot = replace(stream.partition.snapshot(), packs={}, other_layouts={"a": previous_record})
    upgraded = Partition.restore(5, table, to_bytes(snapshot))
    assert upgraded.process("a", blocks[98], upgraded.sequence + 1).state is None  # it was processed before
    for data in blocks[100:]:
        for partition in (stream.partition, upgraded):
            partition.process("a", data, partition.sequence + 1)
    assert upgraded.snapshot().other_layouts == {}
    assert upgraded.state("a")["estimator"].tobytes() == stream.partition.state("a")["estimator"].tobytes()
    assert upgraded.state("a")["hour"].tobytes() == stream.partition.state("a")["hour"].tobytes()


class TestPreviousLayout:
    """Checkpoint with records of another layout: no ``fit_age_s``, one more counter, and another order of fields."""

    @pytest.fixture
    def previous_layout(self, samples):
        """Return a stream after 150 blocks, and its checkpoint as the other version would have written it."""
        stream = Stream(Partition(5, table))
        deliver(stream, "a", blocks_of(samples[:3000]))
        state = stream.partition.state("a")
        layout = json.loads(CURRENT_LAYOUT)
        fields_of = {name: fields for name, fields, _ in layout}
        fields_of["estimator"][:] = [each for each in reversed(fields_of["estimator"]) if each[0] != "fit_age_s"]
        fields_of["delivery"].append(["once_known", "<i8", []])
        dtype = np.dtype(pack_records._dtype_fields(layout))
        work = UnpackedRecord(dtype)
        for part in dtype.names:
            for name in set(dtype[part].names) & set(PACK_STATE[part].names):
                work.record[part][name] = state[part][name]
        work.record["delivery"]["once_known"] = 7
        previous_record = RecordWithLayout(layout_of(dtype), work.packed_bytes())
        snapshot = stream.partition.snapshot()
        return stream, to_bytes(replace(snapshot, packs={}, other_layouts={"a": previous_record}))

    def test_next_block_migrates_the_record_by_field_names(self, previous_layout, samples) -> None:
        stream, data = previous_layout
        unmigrated = stream.partition
        migrated = Partition.restore(5, table, data)
        next_block = blocks_of(samples)[150]
        sequence = migrated.sequence + 1
        expected, estimate = (
            Estimate.model_validate_json(partition.process("a", next_block, sequence).state)
            for partition in (unmigrated, migrated)
        )
        assert estimate.soc == pytest.approx(expected.soc, abs=0.005)
        assert estimate.soc_std < 0.05
        assert estimate.charge_out_ah == pytest.approx(expected.charge_out_ah)
        assert migrated.counters["taken_over"] == 1
        assert migrated.snapshot().other_layouts == {}

    def test_record_keeps_its_layout_until_a_block_is_processed(self, previous_layout, samples) -> None:
        _, data = previous_layout
        partition = Partition.restore(5, table, data)
        blocks = blocks_of(samples)
        assert partition.process("a", blocks[3], partition.sequence + 1).state is None  # it was processed before
        partition.snapshot()
        partition.mark_saved(is_whole=True)
        assert partition.process("a", blocks[155], partition.sequence + 1).reply.number == 3000 // SAMPLES + 1
        assert partition.counters["packs"] == 1
        assert partition.snapshot().other_layouts == read_checkpoint(data).other_layouts
        restored = Partition.restore(5, table, to_bytes(partition.snapshot()))
        assert restored.process("a", blocks[150], restored.sequence + 1).state

    def test_record_is_migrated_after_a_lost_block(self, previous_layout, samples) -> None:
        _, data = previous_layout
        partition = Partition.restore(5, table, data)
        early_block = blocks_of(samples)[151]
        states = [partition.process("a", early_block, partition.sequence + 1).state for _ in range(MAX_EARLY_REPEATS)]
        assert [state is None for state in states] == (MAX_EARLY_REPEATS - 1) * [True] + [False]
        assert partition.counters["lost_blocks"] == 1
        assert partition.snapshot().other_layouts == {}

    def test_record_is_migrated_after_a_lost_and_a_rejected_block(self, previous_layout, samples, monkeypatch) -> None:
        _, data = previous_layout
        partition = Partition.restore(5, table, data)
        early_block, following = blocks_of(samples)[151:153]
        with monkeypatch.context() as patched:
            patched.setattr("bms_estimator.fleet.worker.partition.density_fault", lambda _: "too many samples")
            for _ in range(MAX_EARLY_REPEATS):
                partition.process("a", early_block, partition.sequence + 1)
        assert partition.process("a", following, partition.sequence + 1).state
        assert (partition.counters["lost_blocks"], partition.counters["too_dense"]) == (1, 1)

    def test_record_that_does_not_fit_its_layout_is_reset(self, samples) -> None:
        previous_record = RecordWithLayout(layout_of(np.dtype([("x", "<f8")])), b"1234567")
        partition = Partition.restore(
            5, table, to_bytes(PartitionCheckpoint(5, 0, other_layouts={"a": previous_record}))
        )
        assert partition.process("a", blocks_of(samples)[0], 1).state
        assert partition.counters["damaged_states"] == 1
