"""OCV from several captures: slow charges and discharges, relaxation tests, and given curves."""

from dataclasses import replace

import numpy as np
import pytest

from bms_estimator.calibration.cleaning.capture_checks import StartSoc
from bms_estimator.calibration.ocv.hysteresis import (
    PLATEAU_RESTED_FRACTION,
    RESTED_FRACTION_STD,
    TYPICAL_HYSTERESIS_STD,
    center_on_typical_hysteresis,
)
from bms_estimator.calibration.ocv.slow_branch import measured_capacity_ah, slow_branches
from bms_estimator.calibration.ocv.slow_curve import GRID
from bms_estimator.calibration.ocv.source import ExternalCurve, Recording
from bms_estimator.calibration.ocv.sources import find_sources, subtract_rc_overpotential
from bms_estimator.calibration.ocv.table_fit import NODES, fit_table
from bms_estimator.calibration.ocv_cell import determine_ocv
from bms_estimator.kernels.cell_model.rc_ladder import HYSTERESIS_ACTIVATION_ENERGY, arrhenius
from bms_estimator.model.cell import load_cell
from bms_estimator.model.errors import UserError
from bms_estimator.sources.captures.replay import load_capture
from tests.calibration.simulated_load import TRUTH, capture
from tests.calibration.simulated_relaxation import relaxation, schedule
from tests.calibration.simulated_slow import CAPACITY_AH, CURRENT_A, OHM, hysteresis_v, slow, true_v

INSIDE = (NODES > 0.1) & (NODES < 0.95)


def sources_of(*samples, curves=(), capacity_ah=None, **options):
    """Return the sources of the OCV in captures, which are named run0, run1 and so on, and in given curves."""
    recordings = [Recording(f"run{i}", capture_samples) for i, capture_samples in enumerate(samples)]
    return find_sources(recordings, curves, capacity_ah=capacity_ah, **options)


def ocv_error_v(result):
    """Return the error of the fitted OCV between SOC 0.1 and 0.95 [V]."""
    return (fit_table(result.points).ocv_v - true_v(NODES))[INSIDE]


@pytest.mark.parametrize("files", [1, 2])
def test_a_slow_discharge_and_charge_give_ocv_hysteresis_and_capacity(files):
    """Discharge and charge are in one file or in two."""
    result = sources_of(slow((1.0, -1.0))) if files == 1 else sources_of(slow((1.0,)), slow((-1.0,)))
    (source,) = result.sources
    assert source.kind.startswith("C/20 discharge and charge, 2.99")
    assert result.capacity_ah == result.measured_ah == pytest.approx(CAPACITY_AH, rel=2e-3)
    assert np.abs(ocv_error_v(result)).max() < 2e-3
    # 0.7 is ``RESTED_FRACTION``. The other part of the difference between charge and discharge is polarization.
    assert result.hysteresis_v[INSIDE] == pytest.approx(0.7 * hysteresis_v(NODES[INSIDE]), abs=2e-3)


@pytest.mark.parametrize("noise_a", [0.01, 0.04])
def test_a_noisy_current_sensor_and_a_charge_before_the_discharge_are_accepted(noise_a):
    samples = slow((-1.0, 1.0))
    samples["current_a"] += noise_a * np.random.default_rng(1).standard_normal(samples.size)
    samples["current_a"][[700, 4000]] = 0.5  # glitches
    result = sources_of(samples)
    assert result.sources[0].kind.startswith("C/20 discharge and charge")
    assert result.capacity_ah == pytest.approx(CAPACITY_AH, rel=1e-2)
    assert np.abs(ocv_error_v(result)).max() < 3e-3


def test_an_unpaired_discharge_has_the_hysteresis_in_its_error():
    result = sources_of(slow((1.0,)))
    fit = fit_table(result.points)
    assert result.sources[0].kind.startswith("C/20 discharge, 2.99")
    assert result.hysteresis_v is None
    assert np.median(ocv_error_v(result)) < -5e-3
    assert (np.abs(ocv_error_v(result)) < 2.5 * fit.error_v[INSIDE]).all()


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_an_unpaired_curve_is_moved_by_half_of_a_typical_hysteresis(direction):
    result, typical_v = sources_of(slow((direction,)), capacity_ah=CAPACITY_AH), hysteresis_v(NODES)
    centered = center_on_typical_hysteresis(result, typical_v)
    uncorrected, points = result.points, centered.points
    assert points.ocv_v - uncorrected.ocv_v == pytest.approx(direction * hysteresis_v(uncorrected.soc), abs=1e-4)
    assert (points.systematic_std_v > uncorrected.systematic_std_v).all()
    assert centered.hysteresis_v == pytest.approx(typical_v)
    assert centered.hysteresis_std_v == pytest.approx(TYPICAL_HYSTERESIS_STD * typical_v)


@pytest.mark.parametrize("direction", [1.0, -1.0])
@pytest.mark.parametrize("rested", [True, False])
def test_the_overpotential_of_an_unpaired_curve_is_subtracted(direction, rested):
    """The ohmic drop is also subtracted if no step from or to a rest determines it."""
    samples, ladder = slow((direction,)), load_cell("nca", CAPACITY_AH).ladder
    result = sources_of(samples if rested else samples[samples["current_a"] != 0.0], capacity_ah=CAPACITY_AH)
    uncorrected, (source,) = result.points, subtract_rc_overpotential(result, ladder).sources
    # With a rest, the step of the current has already shown the series resistance, the first row.
    rows = [row for part in (ladder.weak_ohm, ladder.strong_ohm) for row in part[int(rested) :]]
    drop_v = CURRENT_A * sum(np.interp(uncorrected.soc, ladder.soc, row) for row in rows)
    assert source.points.ocv_v - uncorrected.ocv_v == pytest.approx(direction * drop_v, rel=1e-3)
    assert source.points.systematic_std_v == pytest.approx(
        np.hypot(uncorrected.systematic_std_v, ladder.std * drop_v), rel=1e-3
    )
    assert source.notes[-1].startswith(f"{1e3 * drop_v.mean():.0f} mV")


def test_a_cold_unpaired_curve_has_a_larger_overpotential():
    samples, ladder = slow((1.0,)), load_cell("nca", CAPACITY_AH).ladder
    overpotential_v = []
    for temperature_c in (25.0, 0.0):
        samples["temperature_c"] = temperature_c
        result = sources_of(samples)
        overpotential_v.append((subtract_rc_overpotential(result, ladder).points.ocv_v - result.points.ocv_v).mean())
    assert 1.5 < overpotential_v[1] / overpotential_v[0] < 5.0


def test_no_overpotential_is_subtracted_from_pairs_rests_and_given_curves():
    soc, ladder = np.linspace(0.0, 1.0, 101), load_cell("nca", CAPACITY_AH).ladder
    result = sources_of(slow((1.0, -1.0)), relaxation(), curves=[ExternalCurve("book", soc, true_v(soc), None)])
    assert subtract_rc_overpotential(result, ladder) == result


def test_rests_and_given_curves_without_hysteresis_are_moved_by_half_of_a_typical_hysteresis():
    soc = np.linspace(0.0, 1.0, 101)
    result = sources_of(
        relaxation(), curves=[ExternalCurve("book", soc, true_v(soc), None)], capacity_ah=TRUTH.cell.capacity_ah
    )
    centered = center_on_typical_hysteresis(result, np.full(NODES.size, 0.01))
    for before, after in zip(result.sources, centered.sources, strict=True):
        assert after.points.ocv_v - before.points.ocv_v == pytest.approx(0.01)
        assert after.points.std_v == pytest.approx(before.points.std_v)


def test_an_incomplete_charge_is_left_out_with_a_note():
    result = sources_of(slow((1.0,)), slow((-1.0,), moved_fraction=0.85))
    assert result.hysteresis_v is None
    assert len(result.sources) == 1
    assert "charge run1 left out: 2.5" in result.sources[0].notes[0]


def test_the_soc_of_a_slow_curve_of_an_aged_cell_is_counted_with_its_measured_capacity():
    result = sources_of(slow((1.0, -1.0), capacity_ah=2.7), capacity_ah=CAPACITY_AH)
    assert result.capacity_ah == CAPACITY_AH
    assert result.measured_ah == pytest.approx(2.7, rel=2e-3)
    assert "counted against its own 2.69" in result.sources[0].notes[0]
    assert np.abs(ocv_error_v(result)).max() < 2e-3


def test_a_given_curve_and_its_hysteresis_are_used_unchanged():
    soc = np.linspace(0.0, 1.0, 101)
    result = sources_of(curves=[ExternalCurve("book", soc, true_v(soc), hysteresis_v(soc))], capacity_ah=5.0)
    assert [source.kind for source in result.sources] == ["given curve, 101 points"]
    assert np.abs(ocv_error_v(result)).max() < 2e-3
    assert result.hysteresis_v == pytest.approx(hysteresis_v(NODES), abs=1e-3)


def test_a_given_curve_with_a_plateau_has_the_error_of_a_quasi_ocv_unless_its_std_is_given():
    lfp = load_cell("lfp", CAPACITY_AH).ocv
    soc, ocv_v, std_v = np.array(lfp.soc), np.array(lfp.ocv_v), np.full(len(lfp.soc), 0.003)
    for given_v, expected_v in ((None, 0.01), (std_v, 0.003)):
        points = sources_of(curves=[ExternalCurve("book", soc, ocv_v, None, given_v)], capacity_ah=5.0).points
        assert points.systematic_std_v == pytest.approx(expected_v)


@pytest.mark.parametrize("fraction", [0.4, 1.0])
def test_rests_determine_the_remaining_fraction_of_the_hysteresis(fraction):
    soc, rests = np.linspace(0.0, 1.0, 101), relaxation()
    uncorrected = sources_of(rests, capacity_ah=TRUTH.cell.capacity_ah).points
    given_curve = ExternalCurve("book", soc, fit_table(uncorrected)(soc) + fraction * 0.02, np.full(soc.size, 0.02))
    result = sources_of(rests, curves=[given_curve], capacity_ah=TRUTH.cell.capacity_ah)
    centered = result.points.ocv_v[result.points.source == 1]
    assert centered == pytest.approx(uncorrected.ocv_v + fraction * 0.02, abs=1e-3)
    assert result.hysteresis_v == pytest.approx(np.full(NODES.size, fraction * 0.02), abs=1e-3)
    assert f"rests keep {result.hysteresis_v[0] / 0.02:.2f} of its hysteresis" in result.sources[0].notes


def test_a_capture_that_does_not_start_full_is_aligned_by_its_first_rest():
    full, lower = relaxation(), capture(schedule(rounds=12), soc=0.93)
    result = sources_of(full, lower, capacity_ah=TRUTH.cell.capacity_ah)
    assert [test.start_soc for test in result.tests] == [1.0, pytest.approx(0.93, abs=5e-3)]
    assert result.sources[1].notes == (f"starts at SOC {result.tests[1].start_soc:.3f}",)
    only_lower = sources_of(lower, capacity_ah=TRUTH.cell.capacity_ah, initial_soc=0.93)
    assert only_lower.tests[0].start_soc == 0.93


def test_rests_after_charge_within_a_test_are_less_certain():
    """In every fifth round of the test, the load is a charge with half of the current."""
    current_a = schedule(rounds=17)
    is_load = current_a > 0.0
    current_a[is_load & (np.cumsum(np.diff(is_load, prepend=False) & is_load) % 5 == 4)] *= -0.5
    test = sources_of(capture(current_a, soc=1.0), capacity_ah=TRUTH.cell.capacity_ah)
    points, rests = test.points, test.tests[0].rests
    after_charge = np.array([rest.after_charge for rest in rests])
    assert 2 <= after_charge.sum() < 5
    grid = np.linspace(points.soc[0], 0.95, 50)
    uncorrected = fit_table(sources_of(relaxation(), capacity_ah=TRUTH.cell.capacity_ah).points)
    assert fit_table(points)(grid) == pytest.approx(uncorrected(grid), abs=4e-3)
    # Points are in the order of the SOC, rests in the order of time.
    is_after_charge = after_charge[np.argsort(test.tests[0].soc, kind="stable")]
    assert points.std_v[is_after_charge].min() > np.median(points.std_v[~is_after_charge])


def test_pairs_at_several_temperatures_determine_the_temperature_coefficient():
    per_kelvin_v = 3e-4
    runs = [slow((1.0, -1.0), temperature_c=t, offset_v=per_kelvin_v * (t - 25.0)) for t in (10.0, 25.0, 45.0)]
    fit = fit_table(sources_of(*runs).points)
    assert fit.per_kelvin_v is not None
    assert np.median(fit.per_kelvin_v) == pytest.approx(per_kelvin_v, rel=0.3)
    assert np.abs((fit.ocv_v - true_v(NODES))[INSIDE]).max() < 3e-3


@pytest.mark.parametrize(
    ("samples", "capacity_ah", "message"),
    [
        (relaxation, None, "--capacity-ah: not given, and no capture is a slow discharge"),
        (lambda: slow((1.0,), moved_fraction=0.7), None, "--capacity-ah: not given"),
        (lambda: slow((1.0,), moved_fraction=0.7), 1.8, "SOC runs from 1.000 to -0.16"),
        (lambda: capture(np.full(7200, 1.5), soc=1.0), 3.0, "no rests in 1.94 h"),
    ],
)
def test_unusable_captures_are_rejected_with_their_numbers(samples, capacity_ah, message):
    with pytest.raises(UserError, match=message):
        sources_of(samples(), capacity_ah=capacity_ah)


def test_a_slow_discharge_with_the_wrong_sign_is_rejected():
    samples = slow((1.0,))
    samples["current_a"] *= -1.0
    with pytest.raises(UserError, match=r"wrong sign: charge from 3600 s on .*--current-sign"):
        sources_of(samples)


def test_lfp_pairs_at_three_temperatures_give_one_curve(shared_data):
    folder = shared_data / "a123"
    names = [f"c30_{direction}_{at}.csv.gz" for at in ("p25", "p05", "n15") for direction in ("dis", "chg")]
    result = find_sources([Recording(name, load_capture(folder / name).rows) for name in names], [], capacity_ah=None)
    assert result.capacity_ah == pytest.approx(2.06, abs=0.005)
    assert [round(source.temperature_c) for source in result.sources] == [25, 5, -15]
    half_v = np.interp(NODES, GRID, result.sources[0].hysteresis_v)
    assert 0.005 < half_v[INSIDE].min() < half_v[INSIDE].max() < 0.03
    assert result.hysteresis_v == pytest.approx(PLATEAU_RESTED_FRACTION * half_v)
    assert result.hysteresis_std_v == pytest.approx(RESTED_FRACTION_STD * half_v)
    fit = fit_table(result.points)
    warm = result.sources[0].points
    plateau = (warm.soc > 0.15) & (warm.soc < 0.95)
    assert np.abs(fit(warm.soc) - warm.ocv_v)[plateau].max() < 3e-3


def test_the_hysteresis_of_a_cold_pair_is_converted_to_25_c(shared_data):
    folder, mean_v = shared_data / "a123", {}
    for at in ("p25", "n15"):
        names = [f"c30_{direction}_{at}.csv.gz" for direction in ("dis", "chg")]
        result = find_sources(
            [Recording(name, load_capture(folder / name).rows) for name in names], [], capacity_ah=2.06
        )
        temperature_factor = arrhenius(HYSTERESIS_ACTIVATION_ENERGY, result.sources[0].temperature_c)
        half_v = np.interp(NODES, GRID, result.sources[0].hysteresis_v)
        assert result.hysteresis_v == pytest.approx(PLATEAU_RESTED_FRACTION * half_v / temperature_factor)
        mean_v[at] = result.hysteresis_v[INSIDE].mean()
    assert 0.7 < mean_v["n15"] / mean_v["p25"] < 1.8


def test_a_slow_discharge_with_a_gap_of_hours_measures_no_capacity() -> None:
    samples = slow((1.0,))
    middle = samples.size // 2
    with_gap = np.delete(samples, np.s_[middle : middle + 480])  # 4 h
    with pytest.raises(UserError, match="--capacity-ah: not given"):
        sources_of(with_gap)


def test_a_discharge_after_a_charge_that_did_not_fill_the_cell_measures_no_capacity() -> None:
    (discharge,) = slow_branches(slow((1.0,)), "c20", StartSoc())
    charged_before = replace(discharge, start=StartSoc(0.5), before_ah=-0.3 * CAPACITY_AH)
    assert measured_capacity_ah([charged_before, discharge]) == measured_capacity_ah([discharge])


def test_the_first_record_of_a_slow_discharge_with_the_old_voltage_does_not_hide_the_ohmic_step() -> None:
    samples = slow((1.0,))
    first = int(np.argmax(samples["current_a"] > 0.0))
    record = samples[first : first + 1].copy()
    record["time_s"] -= 0.01
    record["voltage_v"] = samples["voltage_v"][first - 1]
    (expected,), (found,) = (
        slow_branches(rows, "c20", StartSoc()) for rows in (samples, np.insert(samples, first, record))
    )
    assert found.step_v == pytest.approx(expected.step_v, abs=1e-9)
    assert found.step_v == pytest.approx(OHM * CURRENT_A, abs=2e-3)


@pytest.mark.parametrize("initial_soc", [0.45, 0.6, 0.9])
def test_a_curve_that_does_not_begin_full_needs_the_soc_at_its_start(initial_soc) -> None:
    whole = slow((1.0,))
    soc = 1.0 - np.r_[0.0, np.cumsum(whole["current_a"][:-1])] * 30.0 / 3600.0 / CAPACITY_AH
    begin = int(np.argmax(soc <= initial_soc))
    rest = whole[:60].copy()
    rest["voltage_v"] += true_v(initial_soc) - true_v(1.0)
    rest["time_s"] += whole["time_s"][begin] - 30.0 * 60
    partial = np.concatenate([rest, whole[begin:]])
    recording = Recording("half", partial)
    with pytest.raises(
        UserError, match=r"--soc: not given, and nothing proves that the cell is full at the start of half"
    ):
        determine_ocv([recording], [], name="mine", series_count=1)
    given = determine_ocv([recording], [], name="mine", series_count=1, initial_soc=initial_soc)
    assert given.sources.capacity_ah == pytest.approx(CAPACITY_AH, rel=0.01)
