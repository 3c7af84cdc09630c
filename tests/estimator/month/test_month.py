"""Truth and determinism of the simulated weeks."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.model.arrays import SampleStatus
from bms_estimator.pack_model.cell_curves import CellCurves
from tests.conftest import SHARED_DATA
from tests.estimator.anywhere.truth import rest_state, simulate, simulate_from
from tests.estimator.anywhere.use import DAY_S
from tests.estimator.month.cases import NEW, Case, Recording
from tests.estimator.month.packs import draw_pack
from tests.estimator.month.run import FULL_SOC, bound_of, run
from tests.estimator.month.simulation import FAST_SAMPLES, Aging, SimulatedPack
from tests.estimator.month.sources import BMS, BOARD, SOLAR, SPLIT, Source
from tests.estimator.month.summary import Table, changes, read, write
from tests.estimator.month.topics import Topics, paired
from tests.estimator.month.uses import SHED_SOC, USES, Phase

AGED = Aging("1 % a day", 0.01, 0.02)
TWO_DAYS = Case("LG M50", "full_nightly", days=2)


def draw(case: Case) -> Recording:
    """Draw a case of a cell in this repository."""
    return case.draw(SHARED_DATA)


def step_s(use: str) -> float:
    """Return the time between two samples."""
    return USES[use].step_s


@pytest.mark.parametrize("use", USES)
def test_the_true_soc_is_the_counted_charge_over_the_present_capacity(use: str) -> None:
    """The bicycle has gaps, because its electronics are off during charges. The SOC is compared between adjacent samples only."""
    source = SOLAR if step_s(use) > 1.0 else BOARD
    truth = draw(Case("LFP", use, source, days=2, aging=AGED)).truth
    is_next = np.isclose(np.diff(truth["time_s"]), step_s(use))
    counted = -truth["current_a"][:-1] * step_s(use) / 3600.0 / truth["capacity_ah"][:-1]
    assert is_next.mean() > 0.99
    assert np.abs(np.diff(truth["soc"]) - counted)[is_next].max() < 1e-12
    assert np.ptp(counted[is_next]) > 1e-7


def test_the_same_seed_gives_the_same_samples_and_another_seed_others() -> None:
    first, again, other = draw(TWO_DAYS), draw(TWO_DAYS), draw(replace(TWO_DAYS, seed=2))
    assert np.array_equal(first.samples, again.samples)  # their bytes differ in the padding
    assert np.array_equal(first.truth, again.truth)
    assert first.truth["capacity_ah"][0] != other.truth["capacity_ah"][0]
    assert not np.array_equal(first.samples["current_a"], other.samples["current_a"])


@pytest.mark.parametrize("source", [BMS, SPLIT])
def test_every_source_measures_the_same_use(source: Source) -> None:
    exact, measured = draw(TWO_DAYS), draw(replace(TWO_DAYS, source=source))
    assert np.array_equal(exact.truth, measured.truth)
    assert np.abs(exact.samples["current_a"] - measured.samples["current_a"]).max() <= source.ampere_step / 2 + 1e-9


def test_a_split_source_repeats_each_voltage_for_ten_seconds() -> None:
    voltage_v = draw(replace(TWO_DAYS, source=SPLIT)).samples["voltage_v"].reshape(-1, 10)
    assert (voltage_v == voltage_v[:, :1]).all()
    assert np.unique(voltage_v[:, 0]).size > 100


def test_a_skewed_source_has_each_voltage_and_each_current_once_at_its_own_time() -> None:
    block = draw(TWO_DAYS).samples[:600]
    samples = paired(Topics(current_shift_s=5.0), block)
    for bit, name, shift in ((SampleStatus.VOLTAGE_HELD, "voltage_v", 0), (SampleStatus.CURRENT_HELD, "current_a", 5)):
        new = samples[samples["status"] & bit == 0][1:-1]
        assert new["time_s"] % 10.0 == pytest.approx(shift, abs=1.0)
        assert new[name] == pytest.approx(block[name][np.floor(new["time_s"]).astype(int)], abs=1e-6)
        assert np.diff(new["time_s"]) == pytest.approx(10.0)


def test_the_charger_ends_each_night_within_one_percent_of_full() -> None:
    truth = draw(TWO_DAYS).truth
    for day in (1, 2):
        assert truth["soc"][truth["time_s"] < day * DAY_S][-1] == pytest.approx(1.0, abs=0.01)


def test_a_solar_pack_is_never_full_and_never_below_the_limit_of_its_loads() -> None:
    soc = draw(Case("LFP", "solar", SOLAR, declared_ah=20.0, days=7)).truth["soc"]
    assert soc.min() > SHED_SOC - 0.01
    assert soc.max() < 0.95
    assert np.ptp(soc) > 0.2


def test_the_electronics_of_a_bicycle_are_off_during_each_charge() -> None:
    recording = draw(Case("LG M50", "bicycle", days=4))
    gaps = np.flatnonzero(np.diff(recording.samples["time_s"]) > 3600.0)
    assert gaps.size >= 3
    assert (recording.truth["soc"][gaps + 1] > recording.truth["soc"][gaps]).all()


def test_a_pack_loses_capacity_and_gains_resistance_with_time() -> None:
    voltage_v, capacity_ah = [], []
    for days in (0, 10):
        pack = SimulatedPack(draw_pack("LG M50", 3.0, 1, SHARED_DATA), USES["full_nightly"], AGED, 0.5)
        pack.time_s = days * DAY_S
        history = pack.run(Phase(np.array([0.0, 3.0])))
        voltage_v.append(history["voltage_v"][0] - history["voltage_v"][1])
        capacity_ah.append(history["capacity_ah"][0])
    assert capacity_ah[1] == pytest.approx(0.9 * capacity_ah[0])
    assert voltage_v[1] == pytest.approx(1.2 * voltage_v[0], rel=1e-6)


def test_a_simulation_in_two_parts_equals_one_in_a_single_part() -> None:
    current_a = np.random.default_rng(1).normal(0.5, 1.0, 2000)
    room_c = np.full(current_a.size, 25.0)
    pack = draw_pack("LG M50", 3.0, 1, SHARED_DATA).truth
    arguments = pack.capacity_ah, pack.ocv_v, pack.per_kelvin_v, pack.hysteresis_v, pack.ohm
    whole_v, whole_soc = simulate(1.0, current_a.copy(), room_c, 0.7, 1.0, *arguments)
    state = rest_state(0.7, 1.0)
    parts = [
        simulate_from(state, 1.0, part.copy(), room_c, *arguments, 0.0, -np.inf, np.inf)
        for part in np.split(current_a, [700])
    ]
    assert np.array_equal(np.concatenate([p[0] for p in parts]), whole_v)
    assert np.array_equal(np.concatenate([p[1] for p in parts]), whole_soc)


def test_the_day_at_the_rate_of_a_board_has_a_hundred_samples_a_second() -> None:
    phase = Phase(np.linspace(-3.0, 3.0, 60))
    packs = [
        SimulatedPack(draw_pack("LG M50", 3.0, 1, SHARED_DATA), USES["full_nightly"], NEW, 0.5, fast_day)
        for fast_day in (0, 1)
    ]
    slow, fast = (pack.run(phase) for pack in packs)
    assert fast.size == FAST_SAMPLES * slow.size
    assert fast["time_s"][::FAST_SAMPLES] == pytest.approx(slow["time_s"])
    assert fast["voltage_v"][::FAST_SAMPLES] == pytest.approx(slow["voltage_v"], abs=1e-4)
    assert packs[1].soc == pytest.approx(packs[0].soc, abs=1e-9)
    assert packs[1].time_s == pytest.approx(60.0)


def test_a_run_is_scored_day_by_day_and_repeats_exactly() -> None:
    case = Case("LG M50", "bicycle", days=2)
    days = run(case, SHARED_DATA)
    assert [day.number for day in days] == [1, 2]
    assert all(day.score is not None for day in days)
    assert 0.7 < days[-1].capacity_ratio < 1.4
    assert days == run(case, SHARED_DATA)


def test_only_a_full_charge_that_is_seen_lowers_the_bound() -> None:
    recording = draw(replace(TWO_DAYS, use="bicycle"))
    cell = CellCurves(Estimator(recording.cell).cell_file_settings)
    assert recording.truth["soc"].max() > FULL_SOC
    unseen, seen = (bound_of(replace(TWO_DAYS, use=use), cell, recording.truth) for use in ("bicycle", "full_nightly"))
    assert seen < 0.9 * unseen


def test_the_summary_names_each_changed_number(tmp_path: Path) -> None:
    path = tmp_path / "summary.csv"
    table: Table = {("case", "day 1"): (1.0, 100.0, 2.0, 8.0), ("case", "days 2-3"): (2.0, 90.0, 2.0, 8.0)}
    write(table, path)
    assert changes(table, read(path)) == []
    changed: Table = {("case", "day 1"): (1.5, 100.0, 2.0, 8.0)}
    assert changes(changed, read(path)) == ["case, day 1 rmse: 1.500, was 1.00", "case, days 2-3: in one table only"]
