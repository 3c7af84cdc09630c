"""Calibration from captures of any kind: recognition, capacity, data held back, and the model."""

import numpy as np
import pytest

from bms_estimator.calibration.automatic.calibrate import calibrate
from bms_estimator.calibration.automatic.model_fit import hold_back
from bms_estimator.calibration.automatic.recognition import estimate_capacity, recognize
from bms_estimator.calibration.elements.identify import identify
from bms_estimator.cli.cell.calibrate import remarks
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.chen_mora import ocv_of_each
from bms_estimator.model.arrays import SAMPLE
from bms_estimator.model.cell import load_cell, with_capacity
from bms_estimator.model.columns import Columns
from bms_estimator.model.errors import UserError
from bms_estimator.sources.captures.replay import load_capture
from tests.calibration.simulated_load import TRUTH, capture, constant, steps
from tests.calibration.simulated_relaxation import relaxation, schedule

GIVEN = load_cell("nca", 3.0)


@pytest.fixture(scope="module")
def captures() -> dict[str, Columns]:
    """Return captures of ``TRUTH`` by their kind."""
    pulses_a = np.r_[np.zeros(60), np.tile(np.r_[np.full(30, 6.0), np.zeros(300)], 60)]
    return {
        "relaxation": Columns(relaxation(), "relaxation"),
        "drive": Columns(capture(steps(seed=3), soc=1.0), "drive"),
        "pulses": Columns(capture(pulses_a, soc=1.0), "pulses"),
        "constant": Columns(capture(constant(), soc=1.0), "constant"),
    }


@pytest.mark.parametrize(
    ("name", "kind", "gives_ocv"),
    [
        ("relaxation", "relaxation test, 20 rests", True),
        ("pulses", "pulses, 57 rests", True),
        ("constant", "constant discharge at 0.25 C", False),
    ],
)
def test_a_capture_is_recognized_by_its_content(captures, name, kind, gives_ocv) -> None:
    (recognized,) = recognize([captures[name]], TRUTH)
    assert (recognized.kind, recognized.gives_ocv, recognized.gives_resistances) == (kind, gives_ocv, True)


def test_a_charge_above_the_rated_capacity_is_the_capacity(captures) -> None:
    small = load_cell("nca", 2.5)
    estimate = estimate_capacity([captures["relaxation"]], small)
    assert estimate.capacity_ah == pytest.approx(0.97 * TRUTH.cell.capacity_ah, rel=0.01)  # it ends at SOC 0.03
    assert "relaxation, more than the expected 2.5 Ah" in estimate.origin


def test_rests_measure_the_capacity_by_an_ocv_of_the_cell(captures) -> None:
    wrong = TRUTH.model_copy(update={"cell": TRUTH.cell.model_copy(update={"capacity_ah": 4.0})})
    estimate = estimate_capacity([captures[name] for name in ("relaxation", "pulses", "drive")], wrong)
    assert "rests" in estimate.origin
    assert estimate.capacity_ah == pytest.approx(TRUTH.cell.capacity_ah, rel=0.04)


def full_discharge(cell):
    """Return a capture of a cell of 2.4 Ah from full to SOC 0.05, with rests."""
    rest_a = np.zeros(360)
    knee_a = np.r_[np.zeros(900), np.full(216, 1.2), rest_a]  # discharges 3 %
    steps_a = np.tile(np.r_[np.full(736, 1.2), rest_a], 9)
    return Columns(capture(np.r_[knee_a, steps_a], cell=with_capacity(cell, 2.4), soc=1.0), "test")


@pytest.mark.parametrize("chemistry", ["lfp", "nmc", "nca", "lco", "lmo"])
def test_rests_from_full_to_empty_measure_the_capacity_of_an_aged_pack(chemistry) -> None:
    rated = load_cell(chemistry, 3.0)
    estimate = estimate_capacity([full_discharge(rated)], rated)
    assert estimate.capacity_ah == pytest.approx(2.4, rel=0.03)
    assert estimate.relative_std is not None
    assert abs(estimate.capacity_ah / 2.4 - 1.0) < 2.0 * estimate.relative_std
    assert "rests" in estimate.origin


def test_a_capture_without_ocv_is_held_back_first(captures) -> None:
    recognized = recognize([captures[name] for name in ("relaxation", "constant", "pulses")], TRUTH)
    split = hold_back(recognized)
    assert split.held_back is recognized[1]
    assert [each.capture.name for each in split.resistance_captures] == ["relaxation", "pulses"]


def test_the_end_of_a_single_capture_is_held_back_from_the_resistances(captures) -> None:
    (recognized,) = recognize([captures["relaxation"]], TRUTH)
    split = hold_back([recognized])
    first_part = split.resistance_captures[0].capture.rows
    assert split.held_back is recognized
    assert first_part["time_s"][-1] < split.held_back_from_s <= first_part["time_s"][-1] + 1.0
    assert split.ocv_captures == (recognized,)


def test_one_relaxation_test_gives_a_model_with_errors_of_millivolts(captures) -> None:
    calibration = calibrate([captures["relaxation"]], GIVEN, name="mine")
    cell = calibration.model.cell
    assert calibration.has_held_back_data
    assert calibration.model.identification is not None
    assert cell.cell.name == "mine"
    difference_v = ocv_grid(cell)[0] - ocv_grid(TRUTH)[0]
    middle = slice(difference_v.size // 5, -difference_v.size // 20)
    assert np.abs(difference_v[middle]).max() < 0.01
    assert calibration.validations[0].above.voltage_rms_v < 0.02
    assert "Not known, because the captures do not show it: the effect of temperature" in calibration.verdict.text


def test_captures_that_determine_nothing_are_listed_with_their_kind() -> None:
    rest = Columns(capture(np.zeros(7200), soc=0.5), "shelf")
    with pytest.raises(UserError, match=r"no capture determines the OCV or resistances(.|\n)*shelf: rest"):
        calibrate([rest], GIVEN, name="mine")


def test_captures_of_different_chemistries_are_named_with_their_voltages(captures) -> None:
    lfp = relaxation()
    lfp["voltage_v"] *= 3.4 / 4.2
    message = r"not of one cell.*\nlfp: 2\.\d\d to 3\.\d\d V per cell\nrelaxation: \d\.\d\d to 4\.\d\d V per cell$"
    with pytest.raises(UserError, match=message):
        calibrate([captures["relaxation"], Columns(lfp, "lfp")], GIVEN, name="mine")


@pytest.mark.parametrize(("chemistry", "given", "is_warned"), [("lfp", "nmc", True), ("nmc", "lmo", False)])
def test_a_given_chemistry_that_the_measured_ocv_contradicts_is_warned_about(chemistry, given, is_warned) -> None:
    test = full_discharge(load_cell(chemistry, 2.4))
    calibration = calibrate([test], load_cell(given, 2.7), name="mine")
    assert not calibration.capacity.is_measured
    warning = f"the measured OCV fits {chemistry} better than {given}: check --cell, or cell in [pack]"
    assert (warning in calibration.warnings) == is_warned
    assert any("the measured OCV fits" in each for each in calibration.warnings) == is_warned


@pytest.mark.parametrize(
    ("rated_ah", "is_warned"), [(33.0, True), pytest.param(30.0, False, marks=pytest.mark.thorough)]
)
def test_a_rated_capacity_that_a_whole_discharge_contradicts_is_warned_about(data, rated_ah, is_warned) -> None:
    leaf = load_capture(data / "leaf" / "hppc_25c_from_full.csv.gz")
    warnings = calibrate([leaf], load_cell("lmo", rated_ah), name="mine").warnings
    expected = f"{leaf.name} draws 30.47 Ah from full; if it ended when the cell was empty, give --capacity 30.47"
    assert warnings == ((expected,) if is_warned else ())


@pytest.mark.thorough
def test_a_gap_of_hours_after_a_sample_of_a_charge_carries_no_charge(captures) -> None:
    rows = captures["relaxation"].rows.copy()
    last = int(np.flatnonzero(np.diff(rows["current_a"]) > 0.0)[9])  # of a rest
    rows["current_a"][last] = -0.7
    rows["time_s"][last + 1 :] += 16_000.0
    calibration = calibrate([Columns(rows, "interrupted")], GIVEN, name="mine")
    assert calibration.model.identification is not None
    difference_v = ocv_grid(calibration.model.cell)[0] - ocv_grid(TRUTH)[0]
    assert np.abs(difference_v[difference_v.size // 5 : -difference_v.size // 20]).max() < 0.01
    assert calibration.validations[0].above.voltage_rms_v < 0.02


def slow_discharge(cell, initial_soc, *, final_soc=0.0, noise_v=2e-4):
    """Return a capture at C/20 from rest at ``initial_soc`` to rest at ``final_soc``, one sample a minute."""
    capacity_ah = cell.cell.capacity_ah
    minutes = round((initial_soc - final_soc) * 20.0 * 60.0)
    current_a = np.r_[np.zeros(30), np.full(minutes, capacity_ah / 20.0), np.zeros(30)]
    samples = np.zeros(current_a.size, dtype=SAMPLE)
    samples["time_s"], samples["current_a"], samples["temperature_c"] = (
        60.0 * np.arange(current_a.size),
        current_a,
        np.nan,
    )
    soc = initial_soc - np.r_[0.0, np.cumsum(current_a[:-1])] / 60.0 / capacity_ah
    samples["voltage_v"] = ocv_of_each(np.clip(soc, 0.0, 1.0), *ocv_grid(cell)) - 0.03 / capacity_ah * current_a
    samples["voltage_v"] += noise_v * np.random.default_rng(5).standard_normal(soc.size)
    return Columns(samples, "slow")


@pytest.mark.parametrize(("chemistry", "initial_soc"), [("nmc", 0.5), ("nca", 0.7), ("lfp", 0.6), ("lmo", 0.4)])
def test_a_slow_discharge_that_begins_half_full_measures_no_capacity_and_no_ocv(chemistry, initial_soc) -> None:
    cell = load_cell(chemistry, 43.0)
    half = slow_discharge(cell, initial_soc)
    estimate = estimate_capacity([half], cell)
    assert not estimate.from_slow_discharge
    assert estimate.capacity_ah == 43.0
    with pytest.raises(
        UserError, match=r"(?s)no capture determines.*nothing proves that it starts with a full.*give --soc"
    ):
        calibrate([half], cell, name="mine")


@pytest.mark.parametrize("chemistry", ["nmc", "lfp"])
def test_with_the_soc_at_its_start_a_partial_discharge_measures_the_capacity(chemistry) -> None:
    estimate = estimate_capacity([slow_discharge(load_cell(chemistry, 40.0), 0.5)], load_cell(chemistry, 43.0), 0.5)
    assert estimate.from_slow_discharge
    assert estimate.capacity_ah == pytest.approx(40.0, rel=0.01)
    assert estimate.origin == "measured by a slow discharge from the given SOC of 0.5 to empty"


def test_a_discharge_from_full_that_ends_half_full_measures_no_capacity() -> None:
    cell = load_cell("nmc", 43.0)
    assert not estimate_capacity([slow_discharge(cell, 1.0, final_soc=0.4)], cell).from_slow_discharge


def test_a_larger_charge_than_the_rated_capacity_is_a_lower_bound_unless_the_cell_is_full_and_then_empty() -> None:
    cell = load_cell("nmc", 43.0)
    estimate = estimate_capacity([slow_discharge(cell, 1.0, final_soc=0.4)], with_capacity(cell, 20.0))
    assert estimate.capacity_ah == pytest.approx(0.6 * 43.0, rel=0.01)
    assert "a lower bound, because the capture does not run from full to empty" in estimate.origin


@pytest.mark.thorough
def test_the_soc_of_a_start_below_full_is_counted_from_its_voltage() -> None:
    rows = capture(schedule(rounds=30), soc=0.93)
    calibration = calibrate([Columns(rows, "later")], with_capacity(TRUTH, 3.0), name="mine")
    assert calibration.model.ocv.sources.tests[0].start_soc == pytest.approx(0.93, abs=0.01)
    (line,) = calibration.warnings
    assert "nothing proves that it starts with a full cell: its first rest at 4.0" in line
    assert "the SOC is counted from there" in line


def test_the_given_soc_is_that_of_the_captures_at_the_highest_first_voltage(captures) -> None:
    later = Columns(captures["relaxation"].rows[3000:], "later")
    first, second = recognize([captures["relaxation"], later], TRUTH, 0.99)
    assert (first.start.soc, first.start.is_exact) == (0.99, True)
    assert second.start.soc < 0.97


@pytest.mark.thorough
def test_pulses_with_rests_of_less_than_a_minute_measure_no_ocv() -> None:
    pulses_a = np.r_[np.zeros(60), np.tile(np.r_[np.full(90, 0.5), np.zeros(50)], 220)]
    pulses = Columns(capture(pulses_a, soc=1.0), "pulses")
    (recognized,) = recognize([pulses], TRUTH)
    assert (recognized.measures_ocv, recognized.gives_resistances) == (False, True)
    calibration = calibrate([pulses], TRUTH, name="mine")
    assert not calibration.is_ocv_measured
    text = "\n".join(remarks(calibration))
    assert "OCV: estimated from rests of less than 2 minutes" in text
    assert "OCV: measured" not in text


def test_a_first_rest_on_a_plateau_is_named_with_the_socs_that_it_allows() -> None:
    cell = load_cell("lfp", 3.0)
    rows = capture(np.r_[np.zeros(600), np.tile(np.r_[np.full(600, 1.5), np.zeros(900)], 11)], cell=cell, soc=0.85)
    rows["voltage_v"] -= 0.012  # the curve of another make, whose SOC is 0.5 at this voltage
    message = r"give the SOC at the start \(--soc\), because its first rest at 3\.3\d\d V fits SOC 0\.\d\d to 0\.\d\d; or the right"
    with pytest.raises(UserError, match=message):
        identify([Columns(rows, "plateau")], cell)
    assert identify([Columns(rows, "plateau")], cell, initial_soc=0.85).captures[0].initial_soc == 0.85


@pytest.mark.thorough
def test_a_start_on_a_plateau_without_a_contradiction_is_named_beside_the_result() -> None:
    cell = load_cell("lfp", 3.0)
    rows = Columns(
        capture(np.r_[np.zeros(600), np.tile(np.r_[np.full(600, 1.5), np.zeros(900)], 5)], cell=cell, soc=0.7), "load"
    )
    (line,) = identify([rows], cell).undetermined_starts
    assert line.startswith("load: give the SOC at the start (--soc), because its first rest at 3.3")
    assert identify([rows], cell, initial_soc=0.7).undetermined_starts == ()
    assert identify([rows], cell, initial_socs={"load": 0.7}).undetermined_starts == ()


def test_a_slow_discharge_far_below_the_rated_capacity_is_warned_about() -> None:
    half = slow_discharge(load_cell("nca", 3.0), 1.0)
    warnings = calibrate([half], load_cell("nca", 5.0), name="mine").warnings
    assert (
        "the slow discharge measures 60 % of the rated 5 Ah; if it began below full, give the SOC at its start (--soc)"
        in warnings
    )
