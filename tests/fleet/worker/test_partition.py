"""A partition: after any event each pack's state equals that of one estimator over its samples."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from structlog.testing import capture_logs

from bms_estimator.edge.block import Block, encode
from bms_estimator.estimator.estimator import estimator_of, new_estimator
from bms_estimator.fleet.hour_row import Hour
from bms_estimator.fleet.worker import partition as partition_module
from bms_estimator.fleet.worker.block_order import ASKED_EACH, MAX_PASSED, TOLD_EACH
from bms_estimator.fleet.worker.block_processor import AT_ONCE, BlockProcessor
from bms_estimator.fleet.worker.partition import Partition
from bms_estimator.model.cell import load_cell
from bms_estimator.model.fuel_cell import load_any
from bms_estimator.model.payloads import Estimate, ParameterReport
from bms_estimator.settings.observer import IdentifierSettings, ObserverSettings
from bms_estimator.settings.pack import PackSettings, Settings
from bms_estimator.sources.captures.replay import Replay
from tests.estimator.simulated_cell import pulses
from tests.fleet.an_edge import CELL, SETTINGS, STORE, Stream, blocks_of, deliver, one_block, table

HOUR_NS = 3600 * 10**9


@pytest.fixture(scope="module")
def samples():
    return pulses(soc=0.9, hours=2.2)[0]


@pytest.fixture
def stream():
    return Stream(Partition(5, table))


def estimated(samples):
    estimator = estimator_of(SETTINGS, CELL)
    estimator.run(samples)
    return estimator.record


def assert_same(stream: Stream, pack: str, record) -> None:
    state = stream.partition.state(pack)
    assert state is not None
    assert state["estimator"].tobytes() == record.tobytes()


def test_duplicates_gaps_and_resends_over_a_restart_at_every_message_leave_what_one_run_leaves(stream, samples) -> None:
    blocks = blocks_of(samples[:1200])
    others = blocks_of(pulses(soc=0.7, hours=0.4, seed=2)[0])
    order = [1, 1, 2, 5, 6, 3, 4, 4, 2, 9, 10, 11, 12, 13, 14, 5, 6, 7]
    for place, number in enumerate(order):
        stream.send("a", blocks[number - 1])
        stream.send("b", others[place])
        stream.take_over()
    deliver(stream, "a", blocks)
    stream.take_over()
    assert_same(stream, "a", estimated(samples[:1200]))
    assert_same(stream, "b", estimated(pulses(soc=0.7, hours=0.4, seed=2)[0][: 20 * len(order)]))
    counters = stream.partition.counters
    assert counters["samples"] == 1200 + 20 * len(order)
    assert counters["lost_blocks"] == 0
    assert min(counters["resends"], counters["gaps"]) > 0


class Recorded:
    """A capture in memory."""

    fraction, implausible = 1.0, 0

    def __init__(self, samples) -> None:
        self._samples = samples

    def __iter__(self):
        yield self._samples


async def test_the_end_state_is_that_of_a_replay(stream, samples) -> None:
    deliver(stream, "a", blocks_of(samples))
    replayed = new_estimator(SETTINGS, CELL)
    async for block in Replay(Recorded(samples)):
        replayed.run(block)
    assert_same(stream, "a", replayed.record)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.integers(-6, 6), max_size=MAX_PASSED - 2), st.data())
def test_any_order_of_delivery_leaves_the_same(steps, data) -> None:
    """An edge that jumps back and ahead at will, and workers that go on from any earlier snapshot."""
    rows = pulses(soc=0.6, hours=0.1)[0]
    blocks, stream = blocks_of(rows, size=30), Stream(Partition(5, table))
    number, snapshots = 1, [stream.partition.snapshot()]
    for step in steps:
        number = min(max(number + step, 1), len(blocks))
        stream.send("a", blocks[number - 1])
        snapshots.append(stream.partition.snapshot())
    deliver(stream, "a", blocks)
    assert_same(stream, "a", estimated(rows))
    assert stream.partition.counters["samples"] == rows.size
    snapshot = data.draw(st.sampled_from(snapshots))
    again = Partition.restore(5, table, b"".join(snapshot.chunks()))
    for sequence, (pack, message) in enumerate(stream.messages, 1):
        again.take(pack, message, sequence)
    counters = dict(again.counters)
    assert counters.pop("repeated", 0) == snapshot.sequence
    assert counters == stream.partition.counters
    assert again.snapshot().packs == stream.partition.snapshot().packs


def test_a_snapshot_is_as_it_was_whatever_comes_later(stream, samples) -> None:
    blocks = blocks_of(samples[:200])
    deliver(stream, "a", blocks[:5])
    stream.send("unknown", blocks[0])
    snapshot = stream.partition.snapshot()
    before = b"".join(snapshot.chunks())
    deliver(stream, "a", blocks)
    stream.send("unknown", blocks[1])
    assert b"".join(snapshot.chunks()) == before


def test_a_message_that_was_taken_is_not_taken_again(samples) -> None:
    partition = Partition(0, table)
    data = one_block(samples[:20], 1)
    assert partition.take("a", data, 7).state
    assert partition.take("a", data, 7).state is None
    assert partition.sequence == 7
    assert partition.counters["repeated"] == 1


class TestWhatAnEdgeIsTold:
    def test_at_first_and_at_each_tenth_block_what_is_safe(self, stream, samples) -> None:
        blocks = blocks_of(samples[:600])
        told = {number: stream.send("a", data).awaits for number, data in enumerate(blocks, 1)}
        assert [number for number, awaits in told.items() if awaits] == [1, *range(TOLD_EACH, 31, TOLD_EACH)]
        assert (told[20].store, told[20].number, told[20].resend) == (STORE, 21, False)
        stream.take_over()
        assert stream.send("a", one_block(samples[600:620], 31)).awaits.number == 32

    def test_once_a_gap_and_each_fifth_block_that_is_ahead_where_to_send_from(self, stream, samples) -> None:
        blocks = blocks_of(samples[:400])
        stream.send("a", blocks[0])
        told = [stream.send("a", data).awaits for data in blocks[4:16]]
        assert [place for place, awaits in enumerate(told) if awaits] == [0, ASKED_EACH, 2 * ASKED_EACH]
        assert all(awaits.resend and awaits.number == 2 for awaits in told if awaits)

    def test_who_goes_back_to_a_former_store_hears_of_the_present_one(self, stream, samples) -> None:
        stream.send("a", one_block(samples[:20], 1, STORE + 1))
        awaits = stream.send("a", one_block(samples[:20], 10, STORE)).awaits
        assert (awaits.store, awaits.number) == (STORE + 1, 2)
        assert stream.partition.counters["former_store"] == 1


class TestANewStore:
    def test_is_a_gap_as_long_as_the_wall_clock_says(self, stream, samples) -> None:
        first, second = samples[:600], samples[600:1200].copy()
        second["time_s"] -= second["time_s"][0] - 3.0
        deliver(stream, "a", blocks_of(first))
        deliver(stream, "a", blocks_of(second, STORE + HOUR_NS))
        estimator = estimator_of(SETTINGS, CELL)
        estimator.run(first)
        estimator.resume(3600.0 + 3.0 - 599.0)
        estimator.run(second)
        assert_same(stream, "a", estimator.record)

    def test_that_begins_before_the_last_sample_is_a_gap_of_which_nobody_knows_how_long(self, stream, samples) -> None:
        deliver(stream, "a", blocks_of(samples[:600]))
        deliver(stream, "a", blocks_of(samples[:60], STORE + 10**9))
        estimator = estimator_of(SETTINGS, CELL)
        estimator.run(samples[:600])
        estimator.resume(np.inf)
        estimator.run(samples[:60])
        assert_same(stream, "a", estimator.record)

    def test_takes_the_place_of_the_one_before_only_when_its_first_block_is_there(self, stream, samples) -> None:
        deliver(stream, "a", blocks_of(samples[:600]))
        later = blocks_of(samples[:200], STORE + HOUR_NS)
        assert stream.send("a", later[3]).awaits.resend
        stream.take_over()
        deliver(stream, "a", later)
        estimator = estimator_of(SETTINGS, CELL)
        estimator.run(samples[:600])
        estimator.resume(3600.0 - 599.0)
        estimator.run(samples[:200])
        assert_same(stream, "a", estimator.record)


def test_what_never_comes_is_counted_and_the_rest_goes_on(stream, samples) -> None:
    blocks = blocks_of(samples[:400])
    deliver(stream, "a", blocks[:5])
    rest = blocks_of(samples[200:400], oldest=11)
    assert stream.send("a", rest[3]).awaits.number == 11
    deliver(stream, "a", rest, first=11)
    estimator = estimator_of(SETTINGS, CELL)
    estimator.run(samples[:100])
    estimator.run(samples[200:400])
    assert_same(stream, "a", estimator.record)
    assert stream.partition.counters["lost_blocks"] == 5
    assert json.loads(stream.send("a", one_block(samples[400:420], 21)).state)["frames_lost"] == 5


@pytest.mark.parametrize("refused", [None, b"damaged"])
def test_a_block_that_the_edge_sends_in_vain_is_lost_and_the_rest_goes_on(stream, samples, refused) -> None:
    blocks = blocks_of(samples[:400])
    deliver(stream, "a", blocks[:5])
    awaits = stream.send("a", blocks[6]).awaits
    assert (awaits.number, awaits.resend) == (6, True)
    for _ in range(MAX_PASSED - 2):
        if refused:
            stream.send("a", refused)
        assert stream.send("a", blocks[6]).state is None
        stream.take_over()
    assert stream.send("a", blocks[6]).state
    deliver(stream, "a", blocks[7:], first=8)
    estimator = estimator_of(SETTINGS, CELL)
    estimator.run(samples[:100])
    estimator.run(samples[120:400])
    assert_same(stream, "a", estimator.record)
    assert stream.partition.counters["lost_blocks"] == 1


def test_several_blocks_that_never_come_are_lost_and_the_rest_goes_on(stream, samples) -> None:
    blocks = blocks_of(samples[:400])
    deliver(stream, "a", blocks[:5])
    for _ in range(MAX_PASSED - 1):
        assert stream.send("a", blocks[8]).state is None
        assert stream.send("a", blocks[7]).state is None
    assert stream.send("a", blocks[7]).state
    assert stream.partition.counters["lost_blocks"] == 2
    deliver(stream, "a", blocks[8:], first=9)
    estimator = estimator_of(SETTINGS, CELL)
    estimator.run(samples[:100])
    estimator.run(samples[140:400])
    assert_same(stream, "a", estimator.record)


class TestWhatIsPublished:
    def test_the_state_is_that_of_run_for_the_block(self, samples) -> None:
        stream = Stream(Partition(5, table, wall=lambda: 2e9))
        deliver(stream, "a", blocks_of(samples[:580]))
        taken = stream.send("a", one_block(samples[580:600], 30))
        state = Estimate.model_validate_json(taken.state)
        last = estimator_of(SETTINGS, CELL).run(samples[:600])[-1]
        assert (state.soc, state.soc_std, state.stability_margin) == (
            last["soc"],
            last["soc_std"],
            last["stability_margin"],
        )
        assert state.voltage_v == pytest.approx(samples["voltage_v"][580:600].mean())
        steps_ah = 0.5 * (samples["current_a"][:599] + samples["current_a"][1:600]) / 3600.0
        assert state.charge_out_ah - state.charge_in_ah == pytest.approx(steps_ah.sum())
        assert (state.sample_rate_hz, state.frames_received, state.frames_lost) == (1.0, 30, 0)
        assert (state.time, state.publish_time) == ("2024-10-04T00:09:59.000Z", "2033-05-18T03:33:20.000Z")

    def test_parameters_and_the_finished_hour_at_each_new_one(self, stream, samples) -> None:
        made = [stream.send("a", data) for data in blocks_of(samples)]
        assert [place for place, each in enumerate(made) if each.parameters] == [0, 180, 360]
        for each in made:
            if each.parameters:
                ParameterReport.model_validate_json(each.parameters)
        rows = [row for each in made for row in each.hours]
        assert [name for name, _ in rows] == ["a.480000", "a.480001"]
        hours = [Hour.model_validate_json(row) for _, row in rows]
        assert [(row.pack, row.samples, row.seen_s) for row in hours] == [("a", 3600, 3599.0), ("a", 3600, 3600.0)]
        assert hours[0].soc == estimator_of(SETTINGS, CELL).run(samples[:3600])["soc"][-1]

    def test_of_samples_that_cannot_be_used_nothing(self, stream, samples) -> None:
        rows = samples[:20].copy()
        rows["voltage_v"] = 0.0
        taken = stream.send("a", one_block(rows, 1))
        assert (taken.state, taken.parameters) == (None, None)
        assert stream.partition.counters["dropped_samples"] == 20

    def test_a_fuel_cell_and_a_pack_without_identifier_are_estimated_too(self, samples) -> None:
        cell = load_any("pem_30w")
        plain = Settings(identifier=IdentifierSettings(enabled=False))
        packs = {"stack": (Settings(), cell), "plain": (plain, CELL)}
        stream = Stream(Partition(5, packs.get))
        stack = samples[:600].copy()
        stack["voltage_v"], stack["current_a"] = cell.cell.nominal_voltage_v, 1.0
        for name, rows in {"stack": stack, "plain": samples[:600]}.items():
            taken = [stream.send(name, data) for data in blocks_of(rows)]
            stream.take_over()
            estimator = estimator_of(*packs[name])
            estimator.run(rows)
            assert_same(stream, name, estimator.record)
            Estimate.model_validate_json(taken[-1].state)


class TestAPackThatTheTableDoesNotKnow:
    def test_waits_and_is_taken_once_it_is_known(self, samples) -> None:
        packs = {}
        stream = Stream(Partition(5, packs.get))
        blocks = blocks_of(samples[:400])
        for data in blocks[:10]:
            taken = stream.send("a", data)
            assert (taken.state, taken.awaits) == (None, None)
            stream.take_over()
        assert stream.partition.unknown == ("a",)
        assert stream.take_deferred() == []
        packs["a"] = SETTINGS, CELL
        assert [bool(each.state) for each in stream.take_deferred()] == 10 * [True]
        assert stream.partition.unknown == ()
        deliver(stream, "a", blocks)
        assert_same(stream, "a", estimated(samples[:400]))

    def test_is_taken_in_order_where_it_became_known_between_two_blocks(self, samples) -> None:
        packs = {}
        stream = Stream(Partition(5, packs.get))
        blocks = blocks_of(samples[:200])
        for data in blocks[:-1]:
            stream.send("a", data)
        packs["a"] = SETTINGS, CELL
        stream.send("a", blocks[-1])
        assert stream.take_deferred()[-1].awaits.number == len(blocks) + 1
        assert_same(stream, "a", estimated(samples[:200]))

    def test_no_more_names_wait_than_can_be_stored(self, monkeypatch: pytest.MonkeyPatch, samples) -> None:
        monkeypatch.setattr(partition_module, "MAX_UNKNOWN", 3)
        packs = {}
        stream = Stream(Partition(5, packs.get))
        data = one_block(samples[:20], 1)
        for number in range(5):
            stream.send(f"pack{number}", data)
        assert stream.partition.unknown == ("pack0", "pack1", "pack2")
        assert stream.partition.counters["not_deferred"] == 2
        packs["pack4"] = SETTINGS, CELL
        assert stream.send("pack4", data).awaits.number == 2


class TestAPackThatHasToWait:
    @settings(max_examples=25, deadline=None)
    @given(st.lists(st.sampled_from(["send", "defer", "take", "restart"]), max_size=40))
    def test_leaves_the_same_whenever_it_waits_and_whoever_goes_on(self, steps) -> None:
        rows = pulses(soc=0.6, hours=0.1)[0]
        blocks, stream, number = blocks_of(rows, size=30), Stream(Partition(5, table)), 0
        for step in steps:
            if step == "take":
                stream.take_deferred(most=1)
            elif step == "restart":
                stream.take_over()
            elif number < len(blocks):
                stream.send("a", blocks[number], waits=step == "defer")
                number += 1
        stream.take_deferred()
        for data in blocks[number:]:
            stream.send("a", data)
        assert_same(stream, "a", estimated(rows))
        assert stream.partition.counters["samples"] == rows.size
        assert not stream.partition.deferred

    def test_is_taken_in_order_and_turn_about_whoever_goes_on(self, stream, samples) -> None:
        blocks, others = blocks_of(samples[:400]), blocks_of(pulses(soc=0.7, hours=0.2, seed=2)[0][:400])
        for pack, data in [("a", data) for data in blocks[:10]] + [("b", data) for data in others[:10]]:
            stream.send(pack, data, waits=True)
        stream.take_over()
        assert [taken.pack for taken in stream.take_deferred()] == 10 * ["a", "b"]
        stream.take_over()
        deliver(stream, "a", blocks[10:], first=11)
        deliver(stream, "b", others[10:], first=11)
        assert_same(stream, "a", estimated(samples[:400]))
        assert_same(stream, "b", estimated(pulses(soc=0.7, hours=0.2, seed=2)[0][:400]))
        assert "gaps" not in stream.partition.counters


class TestOtherSettings:
    def take(self, stream, samples, first, last):
        for data in blocks_of(samples)[first:last]:
            taken = stream.send("a", data)
        return taken

    def test_of_another_cell_the_pack_begins_anew_and_goes_on_in_order(self, samples) -> None:
        packs = {"a": (SETTINGS, CELL)}
        stream = Stream(Partition(5, packs.get))
        self.take(stream, samples, 0, 20)
        other = load_cell("ncr18650", 4.0)
        packs["a"] = SETTINGS, other
        stream.partition.settings_changed("a")
        self.take(stream, samples, 20, 30)
        estimator = estimator_of(SETTINGS, other)
        estimator.run(samples[400:600])
        assert_same(stream, "a", estimator.record)
        assert stream.partition.counters["begun_anew"] == 1
        assert stream.partition.state("a")["delivery"]["awaited"] == 31

    @pytest.mark.parametrize("taken_over", [False, True])
    def test_of_another_tuning_the_pack_keeps_what_it_has_learned(self, samples, taken_over: bool) -> None:
        packs = {"a": (SETTINGS, CELL)}
        stream = Stream(Partition(5, packs.get))
        self.take(stream, samples, 0, 20)
        soc = stream.partition.state("a")["estimator"]["observer"]["soc"][0]
        packs["a"] = SETTINGS.model_copy(update={"observer": ObserverSettings(alpha=2.8)}), CELL
        if taken_over:  # whoever takes over has the new settings at once
            stream.take_over()
        else:
            stream.partition.settings_changed("a")
        stream.send("a", blocks_of(samples)[3])
        taken = self.take(stream, samples, 20, 21)
        state = Estimate.model_validate_json(taken.state)
        assert state.soc == pytest.approx(soc, abs=0.01)
        assert state.soc_std < 0.05
        assert stream.partition.counters["taken_over"] == 1
        self.take(stream, samples, 21, 40)
        assert stream.partition.counters["taken_over"] == 1

    def test_of_a_pack_that_is_taken_out_of_the_table_the_state_stays(self, samples) -> None:
        packs = {"a": (SETTINGS, CELL)}
        stream = Stream(Partition(5, packs.get))
        self.take(stream, samples, 0, 10)
        of_pack = packs.pop("a")
        stream.partition.settings_changed("a")
        assert self.take(stream, samples, 10, 20).state is None
        packs["a"] = of_pack
        stream.partition.settings_changed("a")
        assert len(stream.take_deferred()) == 10
        assert_same(stream, "a", estimated(samples[:400]))


class TestFaultsOfAnEdge:
    @pytest.mark.parametrize("data", [b"", b"BMSB", b"x" * 5000, bytes(range(256))])
    def test_bytes_that_are_no_block_are_counted(self, stream, data: bytes) -> None:
        assert stream.send("a", data).state is None
        assert stream.send("unknown", data).state is None
        assert stream.partition.counters["damaged"] == 2
        assert stream.partition.unknown == ()

    @pytest.mark.parametrize("time_s", [np.nan, np.inf, -np.inf, -1.0, 1e300])
    def test_times_that_cannot_be_are_none(self, stream, samples, time_s: float) -> None:
        rows = samples[:600].copy()
        rows["time_s"][190:230] = time_s
        deliver(stream, "a", blocks_of(rows))
        good = np.delete(samples[:600], np.s_[190:230])
        estimator = estimator_of(SETTINGS, CELL)
        estimator.run(good)
        assert stream.partition.counters["no_time"] == 40
        assert stream.partition.state("a")["estimator"]["observer"]["soc"] == estimator.state["soc"]

    def test_a_block_with_which_something_fails_is_left_out_and_all_go_on(self, stream, samples, monkeypatch) -> None:
        def fail(*_args) -> None:
            raise RuntimeError("of ours")

        blocks = blocks_of(samples[:400])
        deliver(stream, "a", blocks[:9])
        with monkeypatch.context() as patched, capture_logs() as logs:
            patched.setattr(BlockProcessor, "_state", fail)  # after the estimator has taken the samples
            taken = stream.send("a", blocks[9])
            stream.send("new", blocks[0])
        assert (taken.state, taken.failed, taken.awaits.number, taken.awaits.resend) == (None, 1, 11, False)
        assert [(line["event"], line["pack"], line["number"]) for line in logs] == [
            ("a block is left out", "a", 10),
            ("a block is left out", "new", 1),
        ]
        assert stream.partition.counters["failed"] == 2
        other = json.loads(stream.send("b", one_block(samples[220:240], 1)).state)
        assert other["voltage_v"] == pytest.approx(samples["voltage_v"][220:240].mean())  # nothing of theirs in it
        deliver(stream, "a", blocks[10:], first=11)
        deliver(stream, "new", blocks[1:], first=2)
        estimator = estimator_of(SETTINGS, CELL)
        estimator.run(samples[:180])
        estimator.run(samples[200:400])
        assert_same(stream, "a", estimator.record)
        assert_same(stream, "new", estimated(samples[20:400]))

    def test_an_edge_may_hear_what_time_it_is_after_it_began(self, stream, samples) -> None:
        rows = samples[:400].copy()
        rows["time_s"][200:] += 1.8e9  # since 1970
        deliver(stream, "a", blocks_of(rows, store=10**9))
        assert stream.partition.counters["dropped_samples"] == 0
        assert_same(stream, "a", estimated(rows))

    def test_time_that_goes_back_is_counted_as_it_is_everywhere(self, stream, samples) -> None:
        rows = samples[:600].copy()
        rows["time_s"][300:] -= 100.0
        deliver(stream, "a", blocks_of(rows))
        assert_same(stream, "a", estimated(rows))
        assert stream.partition.counters["time_steps_back"] == 1

    @pytest.mark.parametrize("arrival_s", [-1e300, -1.0, 1e300])
    def test_an_arrival_that_cannot_be_is_that_of_the_last_sample(self, stream, samples, arrival_s: float) -> None:
        taken = stream.send("a", encode(Block(STORE, 1, 1, arrival_s, samples[:20])))
        assert Estimate.model_validate_json(taken.state).time == "2024-10-04T00:00:19.000Z"
        assert stream.partition.counters["no_arrival"] == 1

    @given(
        st.lists(
            st.tuples(
                st.sampled_from([1, 2, STORE, STORE + 1, 2**63 - 1]),
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
    def test_nothing_that_a_header_or_a_sample_says_is_an_exception(self, sent) -> None:
        stream = Stream(Partition(5, table))
        rows = pulses(hours=0.02)[0][:3]
        for store, number, oldest, arrival_s, time_s, value in sent:
            rows["time_s"][1], rows["voltage_v"][2] = time_s, value
            block = Block(store, number, min(oldest, number), arrival_s, rows)
            for pack in ("a", "unknown"):
                stream.send(pack, encode(replace(block, samples=rows)))
            stream.take_over()


def test_a_block_of_hours_is_as_many_small_ones(stream, samples) -> None:
    long, short = stream.send("a", one_block(samples, 1)), Stream(Partition(5, table))
    last = [short.send("a", data) for data in blocks_of(samples, size=AT_ONCE // 2)][-1]
    assert_same(stream, "a", estimated(samples))
    assert_same(short, "a", estimated(samples))
    of_long, of_short = (json.loads(taken.state) for taken in (long, last))
    assert of_long["sample_rate_hz"] == of_short["sample_rate_hz"] == 1.0
    assert of_long["voltage_v"] == pytest.approx(samples["voltage_v"].mean())
    net = [told["charge_out_ah"] - told["charge_in_ah"] for told in (of_long, of_short)]
    assert net[0] == pytest.approx(net[1])


def test_packs_of_many_types_do_not_disturb_each_other(samples) -> None:
    cells = {str(n): load_cell("ncr18650", 2.5 + 0.1 * n) for n in range(3)}
    packs = {name: (Settings(pack=PackSettings(name=name)), cell) for name, cell in cells.items()}
    stream = Stream(Partition(5, packs.get))
    for data in blocks_of(samples[:200]):
        for name in packs:
            stream.send(name, data)
    for name, of_pack in packs.items():
        estimator = estimator_of(*of_pack)
        estimator.run(samples[:200])
        assert_same(stream, name, estimator.record)
