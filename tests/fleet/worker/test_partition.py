"""Partition: after any event the state of each pack equals that of an estimator run over its samples."""

import json
import tomllib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from structlog.testing import capture_logs

from bms_estimator.cli.fleet.packs import pack_files
from bms_estimator.edge.block import Block, encode
from bms_estimator.estimator.estimator import compiled_estimator, make_estimator
from bms_estimator.fleet.hour_row import Hour
from bms_estimator.fleet.packs.pack_registry import PackRegistry
from bms_estimator.fleet.packs.pack_row import PackSpec, encode_row
from bms_estimator.fleet.worker import partition as partition_module
from bms_estimator.fleet.worker.block_order import CONFIRM_EVERY, MAX_EARLY_REPEATS, REQUEST_EVERY
from bms_estimator.fleet.worker.block_processor import MAX_PART_SAMPLES, BlockProcessor
from bms_estimator.fleet.worker.partition import Partition
from bms_estimator.model.arrays import NO_CELLS, SAMPLE, SampleBlock
from bms_estimator.model.cell import load_cell
from bms_estimator.model.pack_model import load_model
from bms_estimator.model.payloads.estimate import Estimate
from bms_estimator.model.payloads.snapshot import ParameterReport
from bms_estimator.settings.observer import IdentifierSettings, ObserverSettings
from bms_estimator.settings.pack import PackSettings, Settings
from bms_estimator.sources.captures.replay import Replay
from tests.estimator.simulated_cell import pulses
from tests.fleet.partition_stream import (
    CELL,
    SETTINGS,
    STORE_ID_NS,
    Stream,
    blocks_of,
    deliver,
    estimates_of,
    one_block,
    table,
)

HOUR_NS = 3600 * 10**9


@pytest.fixture(scope="module")
def samples():
    return pulses(soc=0.9, hours=2.2)[0]


@pytest.fixture
def stream():
    return Stream(Partition(5, table))


def record_of_one_run(samples):
    """Return the record of an estimator that has processed the samples in one run."""
    estimator = make_estimator(SETTINGS, CELL)
    estimator.run(samples)
    return estimator.record


def assert_state_equals(stream: Stream, pack: str, record) -> None:
    """Check that the estimator's record of a pack equals ``record`` bit for bit."""
    state = stream.partition.state(pack)
    assert state is not None
    assert estimates_of(state["estimator"]) == estimates_of(record)


def test_duplicates_gaps_resends_and_a_takeover_after_each_message_give_the_state_of_one_run(stream, samples) -> None:
    blocks = blocks_of(samples[:1200])
    blocks_of_b = blocks_of(pulses(soc=0.7, hours=0.4, seed=2)[0])
    numbers = [1, 1, 2, 5, 6, 3, 4, 4, 2, 9, 10, 11, 12, 13, 14, 5, 6, 7]
    for index, number in enumerate(numbers):
        stream.send("a", blocks[number - 1])
        stream.send("b", blocks_of_b[index])
        stream.take_over()
    deliver(stream, "a", blocks)
    stream.take_over()
    assert_state_equals(stream, "a", record_of_one_run(samples[:1200]))
    assert_state_equals(stream, "b", record_of_one_run(pulses(soc=0.7, hours=0.4, seed=2)[0][: 20 * len(numbers)]))
    counters = stream.partition.counters
    assert counters["samples"] == 1200 + 20 * len(numbers)
    assert counters["lost_blocks"] == 0
    assert min(counters["resends"], counters["gaps"]) > 0


class MemoryCapture:
    """Capture in memory."""

    fraction, implausible, cells = 1.0, 0, NO_CELLS  # as ``Replay`` needs them

    def __init__(self, samples) -> None:
        self._samples = samples

    def __iter__(self):
        yield self._samples


async def test_final_state_equals_that_of_a_replay(stream, samples) -> None:
    deliver(stream, "a", blocks_of(samples))
    replayed = compiled_estimator(SETTINGS, CELL)
    async for block, *_ in Replay(MemoryCapture(samples)):
        replayed.run(block)
    assert_state_equals(stream, "a", replayed.record)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.integers(-6, 6), max_size=MAX_EARLY_REPEATS - 2), st.data())
def test_any_order_of_blocks_and_any_earlier_snapshot_give_the_same_state(steps, data) -> None:
    """Send blocks in any order, and continue from any earlier snapshot."""
    rows = pulses(soc=0.6, hours=0.1)[0]
    blocks, stream = blocks_of(rows, size=30), Stream(Partition(5, table))
    number, snapshots = 1, [stream.partition.snapshot()]
    for step in steps:
        number = min(max(number + step, 1), len(blocks))
        stream.send("a", blocks[number - 1])
        snapshots.append(stream.partition.snapshot())
    deliver(stream, "a", blocks)
    assert_state_equals(stream, "a", record_of_one_run(rows))
    assert stream.partition.counters["samples"] == rows.size
    snapshot = data.draw(st.sampled_from(snapshots))
    restored = Partition.restore(5, table, b"".join(snapshot.chunks()))
    for sequence, (pack, message) in enumerate(stream.messages, 1):
        restored.process(pack, message, sequence)
    counters = dict(restored.counters)
    assert counters.pop("repeated", 0) == snapshot.sequence  # messages that the snapshot already includes
    assert counters == stream.partition.counters
    assert restored.snapshot().packs == stream.partition.snapshot().packs


def test_snapshot_does_not_change_with_later_blocks(stream, samples) -> None:
    blocks = blocks_of(samples[:200])
    deliver(stream, "a", blocks[:5])
    stream.send("unknown", blocks[0])
    snapshot = stream.partition.snapshot()
    data = b"".join(snapshot.chunks())
    deliver(stream, "a", blocks)
    stream.send("unknown", blocks[1])
    assert b"".join(snapshot.chunks()) == data


def test_processed_message_is_not_processed_again(samples) -> None:
    partition, sequence = Partition(0, table), 7
    data = one_block(samples[:20], 1)
    assert partition.process("a", data, sequence).state
    assert partition.process("a", data, sequence).state is None
    assert partition.sequence == sequence
    assert partition.counters["repeated"] == 1


class TestReplies:
    """Replies of a partition to the edge of a pack."""

    def test_first_and_each_tenth_block_are_answered(self, stream, samples) -> None:
        blocks = blocks_of(samples[:600])
        replies = {number: stream.send("a", data).reply for number, data in enumerate(blocks, 1)}
        assert [number for number, reply in replies.items() if reply] == [1, *range(CONFIRM_EVERY, 31, CONFIRM_EVERY)]
        assert not any(reply.resend for reply in replies.values() if reply)

    def test_only_blocks_of_two_checkpoints_without_a_common_object_are_confirmed(self, stream, samples) -> None:
        blocks = blocks_of(samples[:1600])
        is_whole_by_block = {15: True, 25: False, 35: True, 45: False, 55: True}
        numbers = []
        for number, data in enumerate(blocks, 1):
            if reply := stream.send("a", data).reply:
                numbers.append((number, reply.number))
            if number in is_whole_by_block:
                stream.save(is_whole=is_whole_by_block[number])
            if number == 65:
                stream.partition.snapshot()  # whose save fails
        assert numbers == [(1, 1), (10, 1), (20, 1), (30, 1), (40, 26), (50, 26), (60, 46), (70, 46), (80, 46)]

    def test_worker_confirms_only_after_its_first_checkpoint(self, stream, samples) -> None:
        blocks = blocks_of(samples[:400])
        deliver(stream, "a", blocks[:5])
        stream.save_twice()
        stream.take_over()
        deliver(stream, "a", blocks[5:9], first=6)
        assert stream.send("a", blocks[9]).reply.number == 1
        stream.save()
        deliver(stream, "a", blocks[10:19], first=11)
        assert stream.send("a", blocks[19]).reply.number == 6

    def test_blocks_that_arrive_while_a_checkpoint_is_saved_are_not_confirmed(self, stream, samples) -> None:
        blocks = blocks_of(samples[:200])
        deliver(stream, "a", blocks[:4])
        for _ in range(2):
            stream.partition.snapshot()
            deliver(stream, "a", blocks[4:9], first=5)
            stream.partition.mark_saved(is_whole=True)
        assert stream.send("a", blocks[9]).reply.number == 5

    def test_missing_block_is_requested_at_the_gap_and_at_each_fifth_block_after_it(self, stream, samples) -> None:
        blocks = blocks_of(samples[:400])
        stream.send("a", blocks[0])
        stream.save_twice()
        replies = [stream.send("a", data).reply for data in blocks[4:16]]  # blocks 2 to 4 are missing
        assert [index for index, reply in enumerate(replies) if reply] == [0, REQUEST_EVERY, 2 * REQUEST_EVERY]
        assert all(reply.resend and reply.number == 2 for reply in replies if reply)

    def test_block_of_a_former_store_is_answered_with_the_present_store(self, stream, samples) -> None:
        stream.send("a", one_block(samples[:20], 1, STORE_ID_NS + 1))
        stream.save_twice()
        reply = stream.send("a", one_block(samples[:20], 10, STORE_ID_NS)).reply
        assert (reply.store, reply.number) == (STORE_ID_NS + 1, 2)
        assert stream.partition.counters["former_store"] == 1

    def test_saved_blocks_of_a_former_store_confirm_none_of_the_new_store(self, stream, samples) -> None:
        deliver(stream, "a", blocks_of(samples[:100]))
        stream.save_twice()
        replies = [stream.send("a", data).reply for data in blocks_of(samples[:200], STORE_ID_NS + 1)]
        assert (replies[-1].store, replies[-1].number) == (STORE_ID_NS + 1, 1)


class TestNewStore:
    """Edge that begins a new store of blocks, whose timestamps begin at zero."""

    def test_gap_between_the_stores_follows_from_their_creation_times(self, stream, samples) -> None:
        first, second = samples[:600], samples[600:1200].copy()
        second["time_s"] -= second["time_s"][0] - 3.0  # begins 3 s after the creation of the second store
        deliver(stream, "a", blocks_of(first))
        deliver(stream, "a", blocks_of(second, STORE_ID_NS + HOUR_NS))
        estimator = make_estimator(SETTINGS, CELL)
        estimator.run(first)
        estimator.resume(unseen_s=3600.0 + 3.0 - 599.0)  # the last sample is 599 s after the first store's creation
        estimator.run(second)
        assert_state_equals(stream, "a", estimator.record)

    def test_store_created_before_the_last_sample_is_a_gap_of_unknown_length(self, stream, samples) -> None:
        deliver(stream, "a", blocks_of(samples[:600]))
        deliver(stream, "a", blocks_of(samples[:60], STORE_ID_NS + 10**9))  # created a second after the first one
        estimator = make_estimator(SETTINGS, CELL)
        estimator.run(samples[:600])
        estimator.resume(unseen_s=np.inf)
        estimator.run(samples[:60])
        assert_state_equals(stream, "a", estimator.record)

    def test_new_store_replaces_the_former_one_only_with_its_first_block(self, stream, samples) -> None:
        deliver(stream, "a", blocks_of(samples[:600]))
        later = blocks_of(samples[:200], STORE_ID_NS + HOUR_NS)
        assert stream.send("a", later[3]).reply.resend
        stream.take_over()
        deliver(stream, "a", later)
        estimator = make_estimator(SETTINGS, CELL)
        estimator.run(samples[:600])
        estimator.resume(unseen_s=3600.0 - 599.0)
        estimator.run(samples[:200])
        assert_state_equals(stream, "a", estimator.record)


def test_blocks_that_the_edge_no_longer_has_count_as_lost(stream, samples) -> None:
    blocks = blocks_of(samples[:400])
    deliver(stream, "a", blocks[:5])
    stream.save_twice()
    later_blocks = blocks_of(samples[200:400], oldest=11)
    reply = stream.send("a", later_blocks[3]).reply  # the edge announces 11 as its oldest block
    assert (reply.number, reply.resend) == (6, True)
    deliver(stream, "a", later_blocks, first=11)
    estimator = make_estimator(SETTINGS, CELL)
    estimator.run(samples[:100])
    estimator.run(samples[200:400])
    assert_state_equals(stream, "a", estimator.record)
    assert stream.partition.counters["lost_blocks"] == 5
    assert json.loads(stream.send("a", one_block(samples[400:420], 21)).state)["frames_lost"] == 5


@pytest.mark.parametrize("rejected_block", [None, b"damaged"])
def test_block_that_never_arrives_or_is_rejected_each_time_counts_as_lost(stream, samples, rejected_block) -> None:
    blocks = blocks_of(samples[:400])
    deliver(stream, "a", blocks[:5])
    stream.save_twice()
    block_after_gap = blocks[6]
    reply = stream.send("a", block_after_gap).reply
    assert (reply.number, reply.resend) == (6, True)
    for _ in range(MAX_EARLY_REPEATS - 2):
        if rejected_block:
            stream.send("a", rejected_block)  # in place of block 6
        assert stream.send("a", block_after_gap).state is None
        stream.take_over()
    assert stream.send("a", block_after_gap).state
    deliver(stream, "a", blocks[7:], first=8)
    estimator = make_estimator(SETTINGS, CELL)
    estimator.run(samples[:100])
    estimator.run(samples[120:400])
    assert_state_equals(stream, "a", estimator.record)
    assert stream.partition.counters["lost_blocks"] == 1


def test_several_blocks_that_never_arrive_count_as_lost(stream, samples) -> None:
    blocks = blocks_of(samples[:400])
    deliver(stream, "a", blocks[:5])
    for _ in range(MAX_EARLY_REPEATS - 1):
        assert stream.send("a", blocks[8]).state is None
        assert stream.send("a", blocks[7]).state is None
    assert stream.send("a", blocks[7]).state
    assert stream.partition.counters["lost_blocks"] == 2  # blocks 6 and 7
    deliver(stream, "a", blocks[8:], first=9)
    estimator = make_estimator(SETTINGS, CELL)
    estimator.run(samples[:100])
    estimator.run(samples[140:400])
    assert_state_equals(stream, "a", estimator.record)


class TestPublishedMessages:
    """Messages that a partition publishes after a block."""

    def test_state_equals_that_of_one_run(self, samples) -> None:
        stream = Stream(Partition(5, table, wall=lambda: 2e9))
        deliver(stream, "a", blocks_of(samples[:580]))
        result = stream.send("a", one_block(samples[580:600], 30))
        state = Estimate.model_validate_json(result.state)
        last = make_estimator(SETTINGS, CELL).run(samples[:600])[-1]
        assert (state.soc, state.soc_std, state.delta_1) == (last["soc"], last["soc_std"], last["delta_1"])
        assert state.voltage_v == pytest.approx(samples["voltage_v"][580:600].mean())
        steps_ah = 0.5 * (samples["current_a"][:599] + samples["current_a"][1:600]) / 3600.0
        assert state.charge_out_ah - state.charge_in_ah == pytest.approx(steps_ah.sum())
        assert (state.sample_rate_hz, state.frames_received, state.frames_lost) == (1.0, 30, 0)
        assert (state.time, state.publish_time) == ("2024-10-04T00:09:59.000Z", "2033-05-18T03:33:20.000Z")

    def test_parameters_and_the_finished_hour_are_published_at_each_new_hour(self, stream, samples) -> None:
        results = [stream.send("a", data) for data in blocks_of(samples)]
        blocks_per_hour = 180
        hour_begins = [0, blocks_per_hour, 2 * blocks_per_hour]
        assert [index for index, result in enumerate(results) if result.parameters] == hour_begins
        for index in hour_begins:
            ParameterReport.model_validate_json(results[index].parameters)
        rows = [row for result in results for row in result.hours]
        assert [name for name, _ in rows] == ["a.480000.181", "a.480001.361"]
        hours = [Hour.model_validate_json(row) for _, row in rows]
        assert [(row.pack, row.samples, row.seen_s) for row in hours] == [("a", 3600, 3599.0), ("a", 3600, 3600.0)]
        assert hours[0].soc == make_estimator(SETTINGS, CELL).run(samples[:3600])["soc"][-1]

    def test_block_without_usable_samples_publishes_nothing(self, stream, samples) -> None:
        rows = samples[:20].copy()
        rows["voltage_v"] = 0.0
        result = stream.send("a", one_block(rows, 1))
        assert (result.state, result.parameters) == (None, None)
        assert stream.partition.counters["dropped_samples"] == 20

    def test_states_of_a_fuel_cell_and_of_a_pack_without_identifier_are_published(self, samples) -> None:
        cell = load_model("pem_30w")
        without_identifier = Settings(identifier=IdentifierSettings(enabled=False))
        packs = {"stack": (Settings(), cell), "plain": (without_identifier, CELL)}
        stream = Stream(Partition(5, packs.get))
        stack = samples[:600].copy()
        stack["voltage_v"], stack["current_a"] = cell.cell.nominal_voltage_v, 1.0
        for name, rows in {"stack": stack, "plain": samples[:600]}.items():
            results = [stream.send(name, data) for data in blocks_of(rows)]
            stream.take_over()
            estimator = make_estimator(*packs[name])
            estimator.run(rows)
            assert_state_equals(stream, name, estimator.record)
            Estimate.model_validate_json(results[-1].state)


class TestUnknownPack:
    """Pack that is not yet in the table of packs."""

    def test_blocks_are_deferred_until_the_pack_is_known(self, samples) -> None:
        packs = {}
        stream = Stream(Partition(5, packs.get))
        blocks = blocks_of(samples[:400])
        for data in blocks[:10]:
            result = stream.send("a", data)
            assert (result.state, result.reply) == (None, None)
            stream.take_over()
        assert stream.partition.unknown == ("a",)
        assert stream.process_deferred() == []
        packs["a"] = SETTINGS, CELL
        assert [bool(each.state) for each in stream.process_deferred()] == 10 * [True]
        assert stream.partition.unknown == ()
        deliver(stream, "a", blocks)
        assert_state_equals(stream, "a", record_of_one_run(samples[:400]))

    def test_deferred_blocks_are_processed_after_the_pack_became_known_between_two_blocks(self, samples) -> None:
        packs = {}
        stream = Stream(Partition(5, packs.get))
        blocks = blocks_of(samples[:200])
        for data in blocks[:-1]:
            stream.send("a", data)
        packs["a"] = SETTINGS, CELL
        stream.send("a", blocks[-1])
        assert stream.process_deferred()[-1].reply.number == 1
        assert_state_equals(stream, "a", record_of_one_run(samples[:200]))

    def test_number_of_deferred_packs_is_limited(self, monkeypatch: pytest.MonkeyPatch, samples) -> None:
        monkeypatch.setattr(partition_module, "MAX_DEFERRED_PACKS", 3)
        packs = {}
        stream = Stream(Partition(5, packs.get))
        data = one_block(samples[:20], 1)
        for number in range(5):
            stream.send(f"pack{number}", data)
        assert stream.partition.unknown == ("pack0", "pack1", "pack2")
        assert stream.partition.counters["not_deferred"] == 2
        packs["pack4"] = SETTINGS, CELL
        assert stream.send("pack4", data).reply


class TestDeferredPack:
    """Pack whose blocks are processed later, because its budget of processor time is exhausted."""

    @settings(max_examples=25, deadline=None)
    @given(st.lists(st.sampled_from(["send", "defer", "take deferred", "take over"]), max_size=40))
    def test_state_does_not_depend_on_deferrals_and_takeovers(self, steps) -> None:
        rows = pulses(soc=0.6, hours=0.1)[0]
        blocks, stream, number = blocks_of(rows, size=30), Stream(Partition(5, table)), 0
        for step in steps:
            if step == "take deferred":
                stream.process_deferred(max_messages=1)
            elif step == "take over":
                stream.take_over()
            elif number < len(blocks):
                stream.send("a", blocks[number], defer=step == "defer")
                number += 1
        stream.process_deferred()
        for data in blocks[number:]:
            stream.send("a", data)
        assert_state_equals(stream, "a", record_of_one_run(rows))
        assert stream.partition.counters["samples"] == rows.size
        assert not stream.partition.deferred

    def test_deferred_blocks_of_packs_are_processed_in_turn_and_in_order_after_a_takeover(
        self, stream, samples
    ) -> None:
        blocks, blocks_of_b = blocks_of(samples[:400]), blocks_of(pulses(soc=0.7, hours=0.2, seed=2)[0][:400])
        for pack, data in [("a", data) for data in blocks[:10]] + [("b", data) for data in blocks_of_b[:10]]:
            stream.send(pack, data, defer=True)
        stream.take_over()
        assert [result.pack for result in stream.process_deferred()] == 10 * ["a", "b"]
        stream.take_over()
        deliver(stream, "a", blocks[10:], first=11)
        deliver(stream, "b", blocks_of_b[10:], first=11)
        assert_state_equals(stream, "a", record_of_one_run(samples[:400]))
        assert_state_equals(stream, "b", record_of_one_run(pulses(soc=0.7, hours=0.2, seed=2)[0][:400]))
        assert "gaps" not in stream.partition.counters


class TestChangedSettings:
    """Pack whose row in the table of packs changes."""

    def send_blocks(self, stream, samples, first, end):
        """Send blocks ``first + 1`` to ``end``, and return the last result."""
        for data in blocks_of(samples)[first:end]:
            result = stream.send("a", data)
        return result

    def test_another_cell_resets_the_estimator_but_not_the_block_numbers(self, samples) -> None:
        packs = {"a": (SETTINGS, CELL)}
        stream = Stream(Partition(5, packs.get))
        self.send_blocks(stream, samples, 0, 20)
        other_cell = load_cell("ncr18650", 4.0)  # a capacity of 4 Ah
        packs["a"] = SETTINGS, other_cell
        stream.partition.in_force.on_table_changed("a")
        self.send_blocks(stream, samples, 20, 30)
        estimator = make_estimator(SETTINGS, other_cell)
        estimator.run(samples[400:600])
        assert_state_equals(stream, "a", estimator.record)
        assert stream.partition.counters["begun_anew"] == 1
        assert stream.partition.state("a")["delivery"]["awaited"] == 31

    @pytest.mark.parametrize("is_taken_over", [False, True])
    def test_another_tuning_keeps_the_learned_values(self, samples, is_taken_over: bool) -> None:
        packs = {"a": (SETTINGS, CELL)}
        stream = Stream(Partition(5, packs.get))
        self.send_blocks(stream, samples, 0, 20)
        soc = stream.partition.state("a")["estimator"]["observer"]["soc"][0]
        packs["a"] = SETTINGS.model_copy(update={"observer": ObserverSettings(alpha=2.8)}), CELL
        if is_taken_over:  # a new owner reads the new settings at once
            stream.take_over()
        else:
            stream.partition.in_force.on_table_changed("a")
        stream.send("a", blocks_of(samples)[3])  # it was processed before, and migrates nothing
        result = self.send_blocks(stream, samples, 20, 21)
        state = Estimate.model_validate_json(result.state)
        assert state.soc == pytest.approx(soc, abs=0.01)
        assert state.soc_std < 0.05
        assert stream.partition.counters["taken_over"] == 1
        self.send_blocks(stream, samples, 21, 40)
        assert stream.partition.counters["taken_over"] == 1

    def test_state_of_a_pack_survives_its_removal_from_the_table(self, samples) -> None:
        packs = {"a": (SETTINGS, CELL)}
        stream = Stream(Partition(5, packs.get))
        self.send_blocks(stream, samples, 0, 10)
        row = packs.pop("a")
        stream.partition.in_force.on_table_changed("a")
        assert self.send_blocks(stream, samples, 10, 20).state is None
        packs["a"] = row
        stream.partition.in_force.on_table_changed("a")
        assert len(stream.process_deferred()) == 10
        assert_state_equals(stream, "a", record_of_one_run(samples[:400]))


class TestInvalidBlocks:
    """Blocks with invalid bytes or implausible values."""

    @pytest.mark.parametrize("data", [b"", b"BMSB", b"x" * 5000, bytes(range(256))])
    def test_invalid_bytes_are_counted(self, stream, data: bytes) -> None:
        assert stream.send("a", data).state is None
        assert stream.send("unknown", data).state is None
        assert stream.partition.counters["damaged"] == 2
        assert stream.partition.unknown == ()

    @pytest.mark.parametrize("time_s", [np.nan, np.inf, -np.inf, -1.0, 1e300])
    def test_samples_with_implausible_timestamps_are_dropped(self, stream, samples, time_s: float) -> None:
        rows = samples[:600].copy()
        rows["time_s"][190:230] = time_s
        deliver(stream, "a", blocks_of(rows))
        plausible = np.delete(samples[:600], np.s_[190:230])
        estimator = make_estimator(SETTINGS, CELL)
        estimator.run(plausible)
        assert stream.partition.counters["no_time"] == 40
        assert stream.partition.state("a")["estimator"]["observer"]["soc"] == estimator.state["soc"]

    def test_block_with_an_internal_error_is_skipped(self, stream, samples, monkeypatch) -> None:
        def fail(*_args) -> None:
            raise RuntimeError("internal error")

        blocks = blocks_of(samples[:400])
        deliver(stream, "a", blocks[:9])
        stream.save_twice()
        with monkeypatch.context() as patched, capture_logs() as logs:
            patched.setattr(BlockProcessor, "_state_payload", fail)  # after the estimator has processed the samples
            result = stream.send("a", blocks[9])
            stream.send("new", blocks[0])
        assert (result.state, result.failed, result.reply.number, result.reply.resend) == (None, 1, 10, False)
        assert [(line["event"], line["pack"], line["number"]) for line in logs] == [
            ("a block is skipped", "a", 10),
            ("a block is skipped", "new", 1),
        ]
        assert stream.partition.counters["failed"] == 2
        other_state = json.loads(stream.send("b", one_block(samples[220:240], 1)).state)
        # the mean of another pack includes no samples of the skipped blocks
        assert other_state["voltage_v"] == pytest.approx(samples["voltage_v"][220:240].mean())
        deliver(stream, "a", blocks[10:], first=11)
        deliver(stream, "new", blocks[1:], first=2)
        estimator = make_estimator(SETTINGS, CELL)
        estimator.run(samples[:180])
        estimator.run(samples[200:400])
        assert_state_equals(stream, "a", estimator.record)
        assert_state_equals(stream, "new", record_of_one_run(samples[20:400]))

    def test_samples_before_and_after_the_clock_of_an_edge_was_set_are_used(self, stream, samples) -> None:
        rows = samples[:400].copy()
        rows["time_s"][200:] += 1.8e9  # since 1970
        deliver(stream, "a", blocks_of(rows, store=10**9))  # created one second after 1970 by a clock that was not set
        assert stream.partition.counters["dropped_samples"] == 0
        assert_state_equals(stream, "a", record_of_one_run(rows))

    def test_step_back_of_the_time_is_counted(self, stream, samples) -> None:
        rows = samples[:600].copy()
        rows["time_s"][300:] -= 100.0
        deliver(stream, "a", blocks_of(rows))
        assert_state_equals(stream, "a", record_of_one_run(rows))
        assert stream.partition.counters["time_steps_back"] == 1

    @pytest.mark.parametrize("arrival_s", [-1e300, -1.0, 1e300])
    def test_implausible_arrival_time_is_replaced_by_the_time_of_the_last_sample(
        self, stream, samples, arrival_s: float
    ) -> None:
        result = stream.send(
            "a",
            encode(Block(store_created_ns=STORE_ID_NS, number=1, oldest=1, arrival_s=arrival_s, samples=samples[:20])),
        )
        assert Estimate.model_validate_json(result.state).time == "2024-10-04T00:00:19.000Z"
        assert stream.partition.counters["no_arrival"] == 1

    @given(
        st.lists(
            st.tuples(
                st.sampled_from([1, 2, STORE_ID_NS, STORE_ID_NS + 1, 2**63 - 1]),
                st.sampled_from([1, 2, 3, 2**62, 2**63 - 1]),
                st.sampled_from([1, 2, 2**62, 2**63 - 1]),
                st.floats(allow_nan=False, allow_infinity=False),
                st.floats(),
                st.floats(),
            ),
            max_size=8,
        )
    )
    @settings(max_examples=60, deadline=None)
    def test_no_value_in_a_header_or_sample_raises_an_error(self, sent) -> None:
        """Send blocks with arbitrary store, number, oldest number, arrival time, sample time and voltage."""
        stream = Stream(Partition(5, table))
        rows = pulses(hours=0.02)[0][:3]
        for store, number, oldest, arrival_s, time_s, voltage_v in sent:
            rows["time_s"][1], rows["voltage_v"][2] = time_s, voltage_v
            block = Block(
                store_created_ns=store, number=number, oldest=min(oldest, number), arrival_s=arrival_s, samples=rows
            )
            for pack in ("a", "unknown"):
                stream.send(pack, encode(replace(block, samples=rows)))
            stream.take_over()


def test_one_long_block_gives_the_state_of_many_short_ones(stream, samples) -> None:
    long_result, short_stream = stream.send("a", one_block(samples, 1)), Stream(Partition(5, table))
    short_blocks = blocks_of(samples, size=MAX_PART_SAMPLES // 2)
    last_short_result = [short_stream.send("a", data) for data in short_blocks][-1]
    assert_state_equals(stream, "a", record_of_one_run(samples))
    assert_state_equals(short_stream, "a", record_of_one_run(samples))
    long_state, short_state = (json.loads(result.state) for result in (long_result, last_short_result))
    assert long_state["sample_rate_hz"] == short_state["sample_rate_hz"] == 1.0
    assert long_state["voltage_v"] == pytest.approx(samples["voltage_v"].mean())
    long_ah, short_ah = (state["charge_out_ah"] - state["charge_in_ah"] for state in (long_state, short_state))
    assert long_ah == pytest.approx(short_ah)


def test_packs_with_different_cells_do_not_affect_each_other(samples) -> None:
    cells = {str(n): load_cell("ncr18650", 2.5 + 0.1 * n) for n in range(3)}
    packs = {name: (Settings(pack=PackSettings(name=name)), cell) for name, cell in cells.items()}
    stream = Stream(Partition(5, packs.get))
    for data in blocks_of(samples[:200]):
        for name in packs:
            stream.send(name, data)
    for name, row in packs.items():
        estimator = make_estimator(*row)
        estimator.run(samples[:200])
        assert_state_equals(stream, name, estimator.record)


def charge_to(full_v: float) -> SampleBlock:
    """Return an hour of charge with a small current at a voltage, between two rests."""
    current_a = np.r_[np.zeros(60), np.full(3600, -0.06 * CELL.cell.capacity_ah), np.zeros(300)]
    samples = np.zeros(current_a.size, dtype=SAMPLE)
    samples["time_s"], samples["current_a"], samples["temperature_c"] = np.arange(current_a.size), current_a, 25.0
    samples["voltage_v"] = np.where(current_a < 0.0, full_v, full_v - 0.01)
    return samples


def test_packs_that_differ_in_their_limits_have_the_states_of_single_services() -> None:
    """The limits are the only difference, so that a type shared by both packs would give one of them the other's limits."""
    samples, registry = charge_to(4.1), PackRegistry()
    specs = {
        "limited": PackSpec(cell="ncr18650", full_voltage_v=4.1, tail_current_a=0.3, cutoff_voltage_v=3.0),
        "default": PackSpec(cell="ncr18650"),
    }
    for name, spec in specs.items():
        registry.set_row(name, encode_row(spec))
    stream = Stream(Partition(5, registry))
    for data in blocks_of(samples, size=600):
        for name in specs:
            stream.send(name, data)
    full_anchors = []
    for name in specs:
        pack_file = tomllib.loads(pack_files(name, registry)["pack.toml"])
        estimator = make_estimator(Settings.model_validate(pack_file), CELL)
        estimator.run(samples)
        assert_state_equals(stream, name, estimator.record)
        full_anchors.append(estimator.record[0]["anchors"]["full_anchors"])
    assert full_anchors == [1, 0]
