"""Identification of the elements of a cell file from captures: accuracy, scores of replays, and rejected captures."""

import numpy as np
import pytest
from scipy.stats import gmean

from bms_estimator.calibration.cleaning.capture_checks import capture_contradictions, initial_soc
from bms_estimator.calibration.cleaning.clean_capture import clean_capture
from bms_estimator.calibration.elements import identify as module
from bms_estimator.calibration.elements.cell_from_fit import LADDER_STD, cell_file_sections
from bms_estimator.calibration.elements.identify import identify
from bms_estimator.calibration.elements.replay_score import interval_score
from bms_estimator.calibration.ocv.overpotential import linear_interpolation_matrix
from bms_estimator.calibration.validate import validate
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.chen_mora import c_tl, c_ts, r_s, r_tl, r_ts
from bms_estimator.model.cell import load_cell
from bms_estimator.model.cell_sections import TableOcv
from bms_estimator.model.columns import Columns
from bms_estimator.model.errors import UserError
from bms_estimator.sources.captures.replay import load_capture
from tests.calibration.simulated_load import LADDER, TRUTH, capture, constant, ladder_capture, steps, wrong_start

WARM_C, COLD_C = 25.0, -5.0
"""Temperatures of the simulated captures [C]."""
OHM = {"r_s": 28e-3, "r_ts": 24e-3, "r_tl": 24e-3}
"""Resistances of ``LADDER`` at SOC 0.5 and 25 C."""


@pytest.fixture(scope="module")
def warm():
    """Return a capture of random steps at 25 C."""
    return Columns(ladder_capture(steps(), WARM_C), "warm")


@pytest.fixture(scope="module")
def cold():
    """Return a capture of random steps at -5 C."""
    return Columns(ladder_capture(steps(3), COLD_C), "cold")


@pytest.fixture(scope="module")
def identified(warm, cold):
    """Return the identification from both captures, which starts from wrong elements."""
    return identify([warm, cold], wrong_start())


@pytest.fixture(scope="module")
def from_warm(warm):
    """Return the identification from the warm capture."""
    return identify([warm], wrong_start())


@pytest.fixture(scope="module")
def fractions():
    """Return the list to which ``from_warm_with_given_ocv`` appends its progress."""
    return []


@pytest.fixture(scope="module")
def from_warm_with_given_ocv(warm, fractions):
    """Return the identification from the warm capture, without a correction of the OCV."""
    return identify([warm], wrong_start(), refine_ocv=False, progress=fractions.append)


def voltage_rms_mv(cell, samples):
    """Return the RMS error of the predicted voltage above SOC 0.1 [mV]."""
    return 1e3 * validate(Columns(samples, "other"), cell).above.voltage_rms_v


def test_the_progress_rises_to_1(from_warm_with_given_ocv, fractions):
    assert len(fractions) > 5
    assert fractions == sorted(set(fractions))
    assert fractions[-1] == pytest.approx(1.0)


def test_identified_resistances_at_25_c_are_within_their_errors(identified):
    for name, ohm in OHM.items():
        value, std = identified.elements[0.5][name]
        assert value == pytest.approx(ohm, rel=0.05 if name == "r_s" else 0.15)
        assert abs(value - ohm) < 2.0 * std < 0.6 * ohm


def test_captures_at_two_temperatures_predict_a_temperature_between(identified, from_warm):
    between = ladder_capture(steps(7), 10.0)
    assert identified.cell.ladder.temperature_c == (COLD_C, WARM_C)
    assert voltage_rms_mv(identified.cell, between) < 6.0
    assert from_warm.cell.ladder.temperature_c == (WARM_C, WARM_C)
    assert voltage_rms_mv(from_warm.cell, between) > 1.5 * voltage_rms_mv(identified.cell, between)


def test_from_one_temperature_the_weak_share_of_each_resistance_is_that_of_the_given_file(identified, warm):
    result = identify([warm], identified.cell).cell.ladder
    ladders = result, identified.cell.ladder
    weak, strong = (np.array([getattr(x, part) for x in ladders]) for part in ("weak_ohm", "strong_ohm"))
    is_positive = (weak + strong > 1e-9).all(axis=0)
    assert is_positive.mean() > 0.8
    fitted_share, given_share = (weak / (weak + strong + 1e-15))[:, is_positive]
    assert fitted_share == pytest.approx(given_share, abs=1e-6)
    assert np.ptp(given_share) > 0.2  # so that the comparison is not trivial
    total_ohm = (weak + strong).sum(axis=1)
    assert total_ohm[0, 2:] == pytest.approx(total_ohm[1, 2:], rel=0.1)
    assert result.temperature_c == (COLD_C, WARM_C)


def growth_near_empty(ladder):
    """Return the sum of all resistances at SOC 0 divided by that at SOC 0.65."""
    ohm = (np.array(ladder.weak_ohm) + np.array(ladder.strong_ohm)).sum(axis=0)
    return ohm[0] / np.interp(0.65, ladder.soc, ohm)


@pytest.mark.thorough
def test_without_data_near_empty_the_resistances_grow_partly_as_in_the_given_file(warm):
    end = int(np.argmax(np.cumsum(warm.rows["current_a"]) > 0.6 * 3600.0 * TRUTH.cell.capacity_ah))
    without_low_soc = Columns(warm.rows[:end], "above")
    growth = {}
    for name, given_growth in (("level", 1.0), ("growing", 4.0)):
        rows = ((0.004 * given_growth, 0.004, 0.004),) * 7
        parts = {"soc": (0.0, 0.3, 1.0), "weak_ohm": rows, "strong_ohm": rows, "std": 0.6}
        given = TRUTH.model_copy(update={"ladder": LADDER.model_copy(update=parts)})
        cell = identify([without_low_soc], given, refine_ocv=False).cell
        growth[name] = growth_near_empty(cell.ladder)
        growth_again = growth_near_empty(identify([without_low_soc], cell, refine_ocv=False).cell.ladder)
        assert growth_again == pytest.approx(growth[name], rel=0.1)
    assert 1.5 * growth["level"] < growth["growing"] < 3.0


def test_a_capture_with_little_information_gives_a_larger_std(warm, from_warm_with_given_ocv):
    from_short = identify([Columns(warm.rows[:700], "short")], wrong_start(), refine_ocv=False)
    std, std_from_short = (result.cell.ladder.std for result in (from_warm_with_given_ocv, from_short))
    assert LADDER_STD < std < 1.3 * LADDER_STD < 1.5 * std < std_from_short


def test_the_two_rc_pairs_of_the_file_are_equivalent_to_its_ladder(identified):
    ladder, a = identified.cell.ladder, identified.cell.a
    for soc in (0.35, 0.5, 0.9):
        rows = np.array(ladder.weak_ohm) + np.array(ladder.strong_ohm)
        ohm = rows @ linear_interpolation_matrix(np.array([soc]), np.array(ladder.soc))[0]
        assert r_s(soc, a) == pytest.approx(ohm[0], rel=0.1)
        assert r_ts(soc, a) == pytest.approx(ohm[1:4].sum(), rel=0.1)
        assert r_tl(soc, a) == pytest.approx(ohm[4:].sum(), rel=0.1)
        # The time constants lie between those of the RC pairs of the ladder that each replaces.
        assert 1.0 < r_ts(soc, a) * c_ts(soc, a) < 30.0
        assert 120.0 < r_tl(soc, a) * c_tl(soc, a) < 2000.0


def test_capacitances_of_a_flat_ladder_are_positive_down_to_empty():
    flat = LADDER.model_copy(update={"weak_ohm": ((0.02,) * 3,) * 7, "strong_ohm": ((0.0,) * 3,) * 7})
    sections = cell_file_sections(flat)
    assert sections["r_s"].offset_ohm == pytest.approx(0.02, rel=1e-3)
    for name in ("c_ts", "c_tl"):
        assert 0.0 < sections[name].amplitude_farad < sections[name].offset_farad


def test_rc_pairs_that_a_slow_capture_does_not_determine_have_small_positive_resistances():
    """With a sample period of a minute, the resistance of RC pairs with time constants of seconds is 0."""
    ladder_without_fast_pairs = LADDER.model_copy(
        update={"weak_ohm": tuple((0.0 if 0 < k < 4 else 0.02,) * 3 for k in range(7)), "strong_ohm": ((0.0,) * 3,) * 7}
    )
    sections = cell_file_sections(ladder_without_fast_pairs)
    assert 0.0 < sections["r_ts"].offset_ohm < 1e-3 * sections["r_tl"].offset_ohm
    assert 1.0 < sections["r_ts"].offset_ohm * sections["c_ts"].offset_farad < 30.0


@pytest.mark.thorough
def test_a_capture_is_held_back_from_its_score_if_another_has_a_similar_temperature(warm, cold):
    other = Columns(ladder_capture(steps(5), WARM_C + 3.0), "other")
    result = identify([warm, cold, other], wrong_start())
    assert [c.held_back for c in result.captures] == [True, False, True]
    assert result.score_after < result.score_before
    for mean, of_captures in (
        (result.score_before, [c.score_before for c in result.captures]),
        (result.score_after, [c.score_after for c in result.captures]),
    ):
        assert mean == pytest.approx(gmean(of_captures))


def test_an_identification_that_makes_replays_worse_is_rejected_with_the_scores(warm, monkeypatch):
    given = wrong_start()
    monkeypatch.setattr(module, "interval_score", lambda cell, *_: 1.5 if cell is given else 5.25)
    with pytest.raises(
        UserError,
        match=r"^replays that start in mid-load get worse: .* from 1\.50 to 5\.25 % of SOC; nothing is written",
    ) as caught:
        identify([warm], given)
    assert "warm: 1.50 before, 5.25 after" in str(caught.value)


def test_the_given_ocv_is_used_if_replays_are_better_with_it(warm, monkeypatch):
    given = wrong_start()
    monkeypatch.setattr(module, "interval_score", lambda cell, *_: 1.5 if cell.ocv is given.ocv else 5.25)
    result = identify([warm], given)
    assert result.cell.ocv == given.ocv
    assert result.ocv_correction_v == 0.0


def test_captures_too_short_for_a_replay_are_identified_without_score():
    result = identify([Columns(ladder_capture(steps()[:1200], WARM_C), "short")], wrong_start())
    assert np.isnan(result.score_before)
    assert np.isnan(result.captures[0].score_after)


def test_the_score_is_larger_if_the_true_soc_is_outside_the_interval():
    load = clean_capture("steps", capture(steps()), TRUTH)
    soc = 0.98 - load.discharged_ah / TRUTH.cell.capacity_ah
    score = interval_score(TRUTH, load, soc)
    assert 0.0 < score < 10.0
    assert interval_score(TRUTH, load, np.clip(soc + 0.2, 0.0, 1.0)) > 3.0 * score


def test_a_wrong_ocv_is_corrected(warm):
    soc = np.linspace(0.0, 1.0, 101)
    true_v = np.interp(soc, np.linspace(0.0, 1.0, ocv_grid(TRUTH)[0].size), ocv_grid(TRUTH)[0])
    wrong_v = true_v + 6e-3 * np.sin(2.0 * np.pi * soc)
    wrong = TableOcv(form="table", soc=tuple(soc), ocv_v=tuple(wrong_v), error_v=(6e-3,) * soc.size)
    result = identify([warm], TRUTH.model_copy(update={"ocv": wrong}), initial_soc=0.98).cell.ocv
    middle = (soc > 0.15) & (soc < 0.95)
    remaining_error_v = np.interp(soc, result.soc, result.ocv_v) - true_v
    assert np.sqrt(np.mean(remaining_error_v[middle] ** 2)) < 0.8 * np.sqrt(np.mean((wrong_v - true_v)[middle] ** 2))
    assert (np.diff(result.ocv_v) > 0.0).all()


@pytest.mark.thorough
def test_an_ocv_error_within_the_hysteresis_hardly_changes_the_curve(warm):
    """With a hysteresis of +-25 mV, an error of 8 mV in a discharge gives no information on the OCV after charge."""
    soc = np.linspace(0.0, 1.0, 101)
    true_v = np.interp(soc, np.linspace(0.0, 1.0, ocv_grid(TRUTH)[0].size), ocv_grid(TRUTH)[0])
    curve_shift_v = {}
    for name, hysteresis_v in (("with hysteresis", 0.025), ("without", None)):
        mean_v = true_v + 8e-3 + (hysteresis_v or 0.0)
        wrong = TableOcv(
            form="table",
            soc=tuple(soc),
            ocv_v=tuple(mean_v),
            error_v=(8e-3,) * soc.size,
            hysteresis_v=None if hysteresis_v is None else (hysteresis_v,) * soc.size,
        )
        result = identify([warm], TRUTH.model_copy(update={"ocv": wrong}), initial_soc=0.98).cell.ocv
        curve_shift_v[name] = np.mean((np.interp(soc, result.soc, result.ocv_v) - mean_v)[20:90])
        assert result.hysteresis_v is None or result.hysteresis_v[0] == hysteresis_v
    assert abs(curve_shift_v["with hysteresis"]) < 0.5 * abs(curve_shift_v["without"])


def test_the_error_of_the_counted_charge_of_a_capture_is_identified(warm, from_warm_with_given_ocv):
    rows = warm.rows.copy()
    rows["current_a"] *= 0.98
    with_small_current = identify([Columns(rows, "lacking")], wrong_start(), refine_ocv=False)
    assert abs(from_warm_with_given_ocv.captures[0].miscount) < 0.001
    # The true value is 0.02. The prior with a std of 0.004 reduces the result.
    assert 0.005 < with_small_current.captures[0].miscount < 0.02


def test_without_refinement_the_ocv_and_its_temperature_coefficient_are_those_of_the_file(warm, cold):
    short = [Columns(each.rows[:6000], each.name) for each in (warm, cold)]
    result = identify(short, wrong_start(), refine_ocv=False)
    assert result.cell.ocv == wrong_start().ocv
    assert result.ocv_correction_v == 0.0


def test_a_pack_is_identified_with_the_accuracy_of_a_cell():
    pack = TRUTH.pack(6, 2)
    samples = capture(2.0 * steps(), cell=pack, noise_v=3e-3)
    result = identify([Columns(samples, "pack")], wrong_start().pack(6, 2))
    # Six cells in series and two in parallel have three times the resistance of a cell.
    assert result.elements[0.5]["r_s"][0] == pytest.approx(3.0 * r_s(0.5, TRUTH.a), rel=0.03)
    assert voltage_rms_mv(result.cell, samples) < 36.0


def test_glitches_do_not_change_the_result(warm, from_warm_with_given_ocv):
    samples = warm.rows.copy()
    rng = np.random.default_rng(5)
    faulty = rng.choice(np.arange(100, samples.size - 100), 60, replace=False)
    samples["voltage_v"][faulty[:20]] = 0.0
    samples["voltage_v"][faulty[20:35]] = 3.0
    samples["voltage_v"][faulty[35:45]] = np.nan
    resting = faulty[45:][samples["current_a"][faulty[45:]] == 0.0]
    samples["current_a"][resting] = 4.6
    samples["time_s"][50:52] = samples["time_s"][49]  # repeated time stamps
    result = identify([Columns(samples, "glitches")], wrong_start(), refine_ocv=False)
    assert result.captures[0].glitches >= 45
    for name in OHM:
        assert result.elements[0.5][name][0] == pytest.approx(from_warm_with_given_ocv.elements[0.5][name][0], rel=0.05)


def with_mismatched_records(samples, rows, voltage_from):
    """Insert a record 10 ms before each of ``rows``, which begin steps of the current.

    The record has the voltage of the row before and the current of the row (``voltage_from`` "before"), as cyclers write the
    first record of a step, or the voltage of the row and the current before it ("after").
    """
    records = samples[rows].copy()
    records["time_s"] -= 0.01
    records["voltage_v" if voltage_from == "before" else "current_a"] = samples[
        "voltage_v" if voltage_from == "before" else "current_a"
    ][rows - 1]
    return np.insert(samples, rows, records)


@pytest.mark.parametrize("voltage_from", ["before", pytest.param("after", marks=pytest.mark.thorough)])
def test_records_whose_voltage_is_of_the_other_side_of_a_step_are_not_used(
    from_warm_with_given_ocv, warm, voltage_from
):
    changes = np.flatnonzero(np.diff(warm.rows["current_a"])) + 1
    capture = Columns(with_mismatched_records(warm.rows, changes, voltage_from), "cycler")
    result, expected = identify([capture], wrong_start(), refine_ocv=False), from_warm_with_given_ocv
    for name in OHM:
        assert result.elements[0.5][name][0] == pytest.approx(expected.elements[0.5][name][0], rel=0.1)
    assert result.captures[0].voltage_rms_v < 1.1 * expected.captures[0].voltage_rms_v


def test_one_mismatched_record_at_the_only_step_does_not_make_the_resistance_zero():
    """A constant load has few steps, so that the jump of the voltage at one of them weighs much."""
    current_a = np.r_[np.zeros(600), np.full(9000, 1.0), np.zeros(1200)]
    samples = ladder_capture(current_a, WARM_C)
    with_record = with_mismatched_records(samples, np.array([600, 9600]), "before")
    ohm, expected_ohm = (
        identify([Columns(rows, "constant")], wrong_start(), refine_ocv=False).elements[0.5]["r_s"][0]
        for rows in (with_record, samples)
    )
    assert ohm == pytest.approx(expected_ohm, rel=0.25)
    assert ohm == pytest.approx(OHM["r_s"], rel=0.4)


def test_a_gap_at_rest_is_accepted():
    samples = ladder_capture(np.r_[steps()[:6000], np.zeros(3600), steps()[6000:]], WARM_C)
    result = identify([Columns(np.delete(samples, np.s_[6060:9540]), "gap")], wrong_start(), refine_ocv=False)
    assert result.elements[0.5]["r_s"][0] == pytest.approx(OHM["r_s"], rel=0.05)


def test_captures_without_excitation_are_left_out(warm):
    slow, short = Columns(capture(constant(0.15, 20_000)), "slow"), Columns(warm.rows[:4000], "warm")
    result = identify([slow, short], wrong_start(), refine_ocv=False)
    assert result.left_out == ("slow",)
    assert [c.name for c in result.captures] == ["warm"]


def test_without_a_sensor_the_given_temperature_is_used(cold):
    capture = Columns(cold.rows.copy(), "cold")
    capture.rows["temperature_c"] = np.nan
    given = identify([capture], wrong_start(), temperature_c=COLD_C, refine_ocv=False)
    assert given.cell.ladder.temperature_c == given.captures[0].temperature_c == (COLD_C, COLD_C)
    unknown = identify([capture], wrong_start(), refine_ocv=False)
    assert given.elements[0.5]["r_s"][0] < unknown.elements[0.5]["r_s"][0]
    with pytest.raises(
        UserError, match=r"^cold: temperature_c runs from 298.0 to 298.0, but cells are between -45 and 85"
    ):
        identify([capture], wrong_start(), temperature_c=298.0)


def test_the_initial_soc_can_be_given_and_a_cold_rest_near_full_is_full():
    samples = ladder_capture(steps(duration_s=6000), COLD_C, soc=1.0)
    samples["voltage_v"] -= 0.015  # so that the OCV would give an SOC below 1
    for given, expected in ((None, 1.0), (0.99, 0.99)):
        result = identify([Columns(samples, "cold")], wrong_start(), initial_soc=given, refine_ocv=False)
        assert result.captures[0].initial_soc == expected


def with_capacity(capacity_ah):
    """Return the true cell with another capacity in its file."""
    cell = TRUTH.cell.model_copy(update={"capacity_ah": capacity_ah})
    return TRUTH.model_copy(update={"cell": cell})


def reverse_current(samples):
    """Reverse the sign of the current."""
    samples["current_a"] *= -1.0
    return samples


def insert_gap(samples):
    """Insert an hour without samples during a load."""
    loaded = int(np.flatnonzero(samples["current_a"] > 0.4)[4000])
    samples["time_s"][loaded:] += 3600.0
    return samples


def hold_voltage(samples, first):
    """Hold the voltage from sample ``first`` on."""
    samples["voltage_v"][first:] = samples["voltage_v"][first]
    return samples


def convert_time_to_hours(samples):
    """Convert the time stamps to hours, as in a column with another unit."""
    samples["time_s"] /= 3600.0
    return samples


@pytest.mark.parametrize(
    ("samples", "cell", "expected_texts"),
    [
        (capture(np.zeros(4000)), TRUTH, ["no excitation", "0.0000 A", "1.11 h"]),
        (reverse_current(capture(steps())), TRUTH, ["sign is wrong", "mV per ampere"]),
        (reverse_current(capture(constant())), TRUTH, ["sign is wrong", "Ah drawn while the voltage went from"]),
        (capture(steps()), with_capacity(2.0), ["outside 0..1", "capacity of 2 Ah"]),
        (capture(steps()), with_capacity(5.0), ["charge and voltage disagree", "capacity of 5 Ah"]),
        (
            hold_voltage(capture(steps()), 0),
            TRUTH,
            ["the voltage is constant", "check the column for repeated old values"],
        ),
        (hold_voltage(capture(steps()), 2000), TRUTH, ["the voltage changes by 0.000 mV per ampere"]),
        (convert_time_to_hours(capture(steps())[:9000]), TRUTH, ["it lasts 2.5 s", "check that time_s is in seconds"]),
        (insert_gap(capture(steps())), TRUTH, ["a gap of 3601 s", "A: the charge drawn in it is unknown"]),
        (
            capture(steps()),
            load_cell("thunder_power_6s"),
            ["lie within the cell's limits", "--series of calibrate, report and validate"],
        ),
    ],
    ids=[
        "rest",
        "sign, steps",
        "sign, constant",
        "capacity too small",
        "capacity too large",
        "dead",
        "stuck",
        "hours",
        "gap",
        "another cell",
    ],
)
def test_a_faulty_capture_is_rejected_with_the_fault_and_its_numbers(samples, cell, expected_texts):
    with pytest.raises(UserError) as caught:
        identify([Columns(samples, "bad.csv")], cell)
    assert str(caught.value).startswith("bad.csv: ")
    assert all(word in str(caught.value) for word in expected_texts)


def test_a_capture_without_faults_contradicts_only_a_wrong_initial_soc():
    load = clean_capture("good", capture(steps()), TRUTH)
    start = initial_soc(load, TRUTH)
    assert capture_contradictions(load, TRUTH, start) == []
    (line,) = capture_contradictions(load, TRUTH, start - 0.4)
    assert "outside 0..1" in line


def test_a_capture_that_stays_empty_is_rejected():
    current_a = np.tile(np.r_[np.full(20, 2.0), np.full(20, -2.0)], 50)
    with pytest.raises(UserError, match=r"near.csv: no sample between SOC 0.02 and 1.01"):
        identify([Columns(capture(current_a, soc=0.5), "near.csv")], TRUTH, initial_soc=0.0)


def test_a_cell_identified_from_a_real_relaxation_test_predicts_random_steps(shared_data):
    folder = shared_data / "ncr18650"
    result = identify([load_capture(folder / "cell5_relaxation_c2.csv.gz")], TRUTH)
    errors = validate(load_capture(folder / "cell5_random_steps.csv.gz"), result.cell).above
    assert errors.voltage_rms_v <= 12e-3
    assert result.elements[0.5]["r_s"][0] == pytest.approx(84.4e-3, rel=0.1)  # median of dV/dI at its steps


def test_a_real_cell_is_identified_from_a_wrong_start_and_predicts_another_load(data):
    """The cell is that of a Nissan Leaf. The fit uses pulses and rests, and the prediction is tested on cycles at 1 C."""
    leaf = load_cell("leaf")
    table = leaf.model_dump() | {"ladder": None}
    for name in ("r_s", "r_ts", "r_tl"):
        table[name] |= {key: 2.0 * table[name][key] for key in ("amplitude_ohm", "offset_ohm")}
    result = identify([load_capture(data / "leaf" / "hppc_25c_from_full.csv.gz")], type(leaf).model_validate(table))
    assert result.elements[0.5]["r_s"][0] == pytest.approx(1.57e-3, rel=0.1)  # median of dV/dI at its steps
    assert result.captures[0].voltage_rms_v < 5e-3
    assert result.score_after < result.score_before
    assert validate(load_capture(data / "leaf" / "cc_1c.csv.gz"), result.cell).above.voltage_rms_v < 25e-3
