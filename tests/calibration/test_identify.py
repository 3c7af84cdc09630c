import numpy as np
import pytest

from bms_estimator.calibration.capture_checks import contradictions
from bms_estimator.calibration.elements import by_theta, from_a, start, to_a
from bms_estimator.calibration.held_current import thinned, whole_load
from bms_estimator.calibration.identifiability import Verdict
from bms_estimator.calibration.identify import corrected_ocv, identify, spline
from bms_estimator.calibration.prediction_error import COEFFICIENTS
from bms_estimator.calibration.validate import validate
from bms_estimator.cli.main import main
from bms_estimator.estimator.records import ocv_grid
from bms_estimator.kernels.cell import c_tl, c_ts, r_s, r_tl, r_ts
from bms_estimator.kernels.sensitivity import sensitivities
from bms_estimator.model.cell import load_cell
from bms_estimator.model.columns import Columns
from bms_estimator.model.errors import UserError
from bms_estimator.sources.replay import load_capture
from tests.calibration.simulated_load import TRUTH, capture, constant, steps, wrong_start


@pytest.fixture(scope="module")
def identified():
    return identify([Columns(capture(steps()), "steps")], wrong_start())


@pytest.fixture(scope="module")
def from_constant_current():
    return identify([Columns(capture(constant()), "constant")], wrong_start())


def deviations(found):
    """Each of a1..a15 less its true value, in standard errors."""
    return np.array([(p.value - TRUTH.a[int(p.name[1:])]) / p.std for p in found.parameters])


def verdicts(found):
    return {p.name: p.verdict for p in found.parameters}


def test_parameters_are_recovered_within_their_standard_errors(identified):
    assert np.abs(deviations(identified)).max() < 3.0
    assert np.sqrt(np.mean(deviations(identified) ** 2)) < 1.3


def test_standard_errors_are_small_where_the_load_tells(identified):
    told = [p for p in identified.parameters if p.verdict is Verdict.IDENTIFIED]
    assert {"a3", "a9", "a12", "a13", "a14", "a15"} <= {p.name for p in told}
    assert all(p.relative_std <= 0.15 for p in told)


@pytest.mark.parametrize("soc", [0.2, 0.5, 0.8])
def test_series_resistance_within_one_percent_and_rc_products_within_five(identified, soc):
    row = {name: value for name, (value, _) in identified.elements[soc].items()}
    a = TRUTH.a
    assert row["r_s"] == pytest.approx(r_s(soc, a), rel=0.01)
    assert row["r_ts"] * row["c_ts"] == pytest.approx(r_ts(soc, a) * c_ts(soc, a), rel=0.05)
    assert row["r_tl"] * row["c_tl"] == pytest.approx(r_tl(soc, a) * c_tl(soc, a), rel=0.05)


def test_identified_cell_predicts_another_load(identified):
    held_back = capture(steps(7), soc=0.9, seed=7)
    assert validate(Columns(held_back, "other"), identified.cell).above.voltage_rms_v < 1e-3
    assert validate(Columns(held_back, "other"), wrong_start()).above.voltage_rms_v > 10e-3


def test_constant_current_is_said_not_to_tell_what_it_cannot(from_constant_current):
    found = verdicts(from_constant_current)
    not_told = {name for name, verdict in found.items() if verdict is Verdict.NOT_TOLD}
    assert {"a1", "a4", "a5", "a6", "a7", "a8", "a10", "a11", "a12"} <= not_told
    assert found["a15"] is not Verdict.IDENTIFIED
    assert np.abs(deviations(from_constant_current)).max() < 3.0


def test_what_a_load_does_not_tell_keeps_about_the_value_of_the_cell_file(from_constant_current):
    for name in ("a5", "a11"):
        ratio = from_constant_current.parameters[int(name[1:]) - 1].value / wrong_start().a[int(name[1:])]
        assert 0.5 < ratio < 2.0


def test_captures_are_fitted_jointly_with_their_own_soc_and_contacts():
    first = capture(steps(1), soc=0.97, seed=1)
    second = capture(steps(2), soc=0.70, seed=2)
    second["voltage_v"] -= 0.006 * second["current_a"]
    found = identify([Columns(first, "first"), Columns(second, "second")], wrong_start())
    assert [c.initial_soc for c in found.captures] == pytest.approx([0.97, 0.70], abs=0.006)
    assert found.captures[1].contact_ohm - found.captures[0].contact_ohm == pytest.approx(0.006, abs=5e-4)


def test_a_pack_is_identified_as_well_as_a_cell():
    pack = TRUTH.pack(6, 2)
    samples = capture(2.0 * steps(), cell=pack, noise_v=3e-3)
    found = identify([Columns(samples, "pack")], wrong_start().pack(6, 2))
    elements = {name: value for name, (value, _) in found.elements[0.5].items()}
    assert elements["r_s"] == pytest.approx(3.0 * r_s(0.5, TRUTH.a), rel=0.01)
    assert elements["r_ts"] * elements["c_ts"] == pytest.approx(r_ts(0.5, TRUTH.a) * c_ts(0.5, TRUTH.a), rel=0.05)
    assert validate(Columns(samples, "pack"), found.cell).above.voltage_rms_v < 6e-3


def test_glitches_do_no_harm(identified):
    samples = capture(steps())
    rng = np.random.default_rng(5)
    places = rng.choice(np.arange(100, samples.size - 100), 60, replace=False)
    samples["voltage_v"][places[:20]] = 0.0
    samples["voltage_v"][places[20:35]] = 3.0
    samples["voltage_v"][places[35:45]] = np.nan
    resting = places[45:][samples["current_a"][places[45:]] == 0.0]
    samples["current_a"][resting] = 4.6
    samples["time_s"][50:52] = samples["time_s"][49]
    found = identify([Columns(samples, "glitches")], wrong_start())
    assert found.captures[0].glitches >= 45
    assert np.abs(deviations(found)).max() < 3.0
    clean = np.array([p.value for p in identified.parameters])
    std = np.array([p.std for p in identified.parameters])
    assert (np.abs(np.array([p.value for p in found.parameters]) - clean) < std).all()


def test_a_gap_at_rest_is_stepped_over():
    samples = capture(np.r_[steps()[:6000], np.zeros(3600), steps()[6000:]])
    found = identify([Columns(np.delete(samples, np.s_[6060:9540]), "gap")], wrong_start())
    assert np.abs(deviations(found)).max() < 3.0


def test_ocv_is_kept_when_asked():
    found = identify([Columns(capture(steps()), "steps")], wrong_start(), refine_ocv=False)
    assert found.cell.ocv == TRUTH.ocv
    assert found.ocv_correction_v == 0.0
    assert np.abs(deviations(found)).max() < 3.0


def test_a_wrong_ocv_is_corrected():
    table = wrong_start().model_dump()
    soc = np.array(table["ocv"]["soc"])
    table["ocv"]["ocv_v"] = tuple(np.array(table["ocv"]["ocv_v"]) + 0.015 * np.sin(3.0 * soc) * (1.0 - soc))
    wrong = type(TRUTH).model_validate(table)
    held_back = capture(steps(7), seed=7)
    kept = identify([Columns(capture(steps()), "steps")], wrong, refine_ocv=False)
    refined = identify([Columns(capture(steps()), "steps")], wrong)
    after = validate(Columns(held_back, "other"), refined.cell).above.voltage_rms_v
    assert after < 1.5e-3
    assert after < 0.5 * validate(Columns(held_back, "other"), kept.cell).above.voltage_rms_v


def test_corrected_table_increases_whatever_the_correction():
    table = corrected_ocv(TRUTH, 0.1 * np.random.default_rng(0).standard_normal(COEFFICIENTS))
    assert (np.diff(table.ocv_v) > 0.0).all()
    assert (table.soc[0], table.soc[-1]) == (0.0, 1.0)


def test_without_correction_the_table_is_the_cells():
    table = corrected_ocv(TRUTH, np.zeros(COEFFICIENTS))
    grid_v, _ = ocv_grid(TRUTH)
    again_v, _ = ocv_grid(TRUTH.model_copy(update={"ocv": table}))
    assert np.abs(again_v - grid_v).max() < 0.5e-3
    np.testing.assert_allclose(spline(np.ones(COEFFICIENTS), np.linspace(-0.1, 1.1, 50)), 1.0)


def test_thinning_loses_neither_charge_nor_voltage():
    whole = whole_load("steps", capture(steps(), noise_v=0.0), TRUTH)
    few = thinned(whole, TRUTH.cell.capacity_ah)
    assert few.time_s.size < 0.3 * whole.time_s.size
    charge_ah = np.r_[0.0, np.cumsum(few.held_a[:-1] * np.diff(few.time_s))] / 3600.0
    np.testing.assert_allclose(charge_ah, few.discharged_ah, atol=1e-12)
    voltage_v = np.empty(few.time_s.size)
    arrays = (few.time_s, few.current_a, few.held_a, 0.98, 0.0, 10800.0, TRUTH.a[:16])
    sensitivities(*arrays, *ocv_grid(TRUTH), np.zeros(4), voltage_v, np.empty((0, 0)))
    assert np.abs(voltage_v - few.voltage_v).max() < 0.3e-3


def test_theta_and_parameters_are_inverse_and_so_are_their_derivatives():
    a = TRUTH.a[:16]
    theta = from_a(a)
    np.testing.assert_allclose(to_a(theta)[1:], a[1:], rtol=1e-12)
    differences = np.array([(to_a(theta + e) - to_a(theta - e))[1:] / 2e-6 for e in 1e-6 * np.eye(15)]).T
    np.testing.assert_allclose(by_theta(theta), differences, rtol=1e-6, atol=1e-6 * np.abs(a[1:]).min())


def test_search_starts_bent_where_the_file_has_an_element_flat():
    flat = TRUTH.a[:16]
    flat[[1, 7]] = 1e-9
    bent = to_a(start(flat))
    assert bent[1] > 0.1 * bent[3]
    assert bent[7] > 0.1 * bent[9]
    np.testing.assert_allclose(bent[[4, 5, 6, 13, 14, 15]], flat[[4, 5, 6, 13, 14, 15]])


def with_capacity(capacity_ah):
    cell = TRUTH.cell.model_copy(update={"capacity_ah": capacity_ah})
    return TRUTH.model_copy(update={"cell": cell})


def flipped(samples):
    samples["current_a"] *= -1.0
    return samples


def with_gap(samples):
    loaded = int(np.flatnonzero(samples["current_a"] > 0.4)[4000])
    samples["time_s"][loaded:] += 3600.0
    return samples


@pytest.mark.parametrize(
    ("samples", "cell", "words"),
    [
        (capture(np.zeros(4000)), TRUTH, ["no excitation", "0.0000 A", "1.11 h"]),
        (flipped(capture(steps())), TRUTH, ["sign is wrong", "mV per ampere"]),
        (flipped(capture(constant())), TRUTH, ["sign is wrong", "Ah drawn while the voltage went from"]),
        (capture(steps()), with_capacity(2.0), ["outside 0..1", "capacity of 2 Ah"]),
        (capture(steps()), with_capacity(5.0), ["charge and voltage disagree", "capacity of 5 Ah"]),
        (with_gap(capture(steps())), TRUTH, ["a gap of 3601 s", "A: the charge drawn in it is unknown"]),
        (capture(steps()), load_cell("thunder_power_6s"), ["lie within the cell's limits", "is it this cell's?"]),
    ],
    ids=["rest", "sign, steps", "sign, constant", "capacity too small", "capacity too large", "gap", "another cell"],
)
def test_bad_input_is_named_with_its_numbers(samples, cell, words):
    with pytest.raises(UserError) as caught:
        identify([Columns(samples, "bad.csv")], cell)
    assert str(caught.value).startswith("bad.csv: ")
    assert all(word in str(caught.value) for word in words)


def test_a_good_capture_contradicts_nothing():
    assert contradictions(whole_load("good", capture(steps()), TRUTH), TRUTH) == []


def errors_on_random_steps(folder, cell, *names):
    """What a cell identified from some captures of cell 5 leaves of another one."""
    found = identify([load_capture(folder / f"cell5_{name}.csv.gz") for name in names], cell)
    return validate(load_capture(folder / "cell5_random_steps.csv.gz"), found.cell).above


@pytest.mark.parametrize("names", [("relaxation_c2",), ("relaxation_c2", "hppc")])
def test_real_cell_predicts_random_steps(shared_data, names):
    errors = errors_on_random_steps(shared_data / "ncr18650", TRUTH, *names)
    assert errors.voltage_rms_v <= 6e-3
    assert errors.mean_abs_percent <= 0.13


@pytest.mark.parametrize("form", ["table", "chen-mora"])
def test_real_cell_from_its_relaxation_test_alone(shared_data, tmp_path, capsys, form):
    folder, out = shared_data / "ncr18650", tmp_path / "own.toml"
    test = folder / "cell5_relaxation_c2.csv.gz"
    with pytest.raises(SystemExit) as ended:
        main(["ocv", str(test), "--capacity-ah", "3.0", "--form", form, "--out", str(out)])
    assert not ended.value.code
    errors = errors_on_random_steps(folder, load_cell(out), "relaxation_c2")
    assert errors.voltage_rms_v <= 6.1e-3
    assert errors.mean_abs_percent <= 0.13


def scaled(cell, factor):
    """The cell with every resistance, and so every time constant, wrong by a factor."""
    table = cell.model_dump()
    for name in ("r_s", "r_ts", "r_tl"):
        table[name] |= {key: factor * table[name][key] for key in ("amplitude_ohm", "offset_ohm")}
    return type(cell).model_validate(table)


def test_a_real_cell_is_identified_from_a_wrong_start_and_predicts_another_load(data):
    """Nissan Leaf: pulses and rests, then cycles at 1C which the fit never saw."""
    found = identify([load_capture(data / "leaf" / "hppc_25c_from_full.csv.gz")], scaled(load_cell("leaf"), 2.0))
    assert {"a9", "a15"} <= {p.name for p in found.parameters if p.verdict is Verdict.IDENTIFIED}
    assert found.elements[0.5]["r_s"][0] == pytest.approx(1.7e-3, rel=0.1)
    assert found.captures[0].voltage_rms_v < 5e-3
    assert validate(load_capture(data / "leaf" / "cc_1c.csv.gz"), found.cell).above.voltage_rms_v < 20e-3


def test_a_real_constant_load_is_said_not_to_tell_what_it_cannot(data):
    """LG M50 at C/2 and back: of the fast branch it tells nothing. A tenth of the load is predicted all the same."""
    points = np.genfromtxt(data / "lgm50" / "ocv_25c.csv", delimiter=",", names=True)
    table = scaled(TRUTH, 1.0).model_dump()
    table["ocv"] = {"form": "table", "soc": tuple(points["soc"]), "ocv_v": tuple(points["ocv_v"])}
    table["cell"] |= {"capacity_ah": 4.95}
    found = identify([load_capture(data / "lgm50" / "rate_0p5c_25c.csv.gz")], type(TRUTH).model_validate(table))
    told = {p.name for p in found.parameters if p.verdict is Verdict.IDENTIFIED}
    assert not told & {"a1", "a2", "a3", "a7", "a8", "a9"}
    assert found.captures[0].voltage_rms_v < 10e-3
    assert validate(load_capture(data / "lgm50" / "rate_0p1c_25c.csv.gz"), found.cell).above.voltage_rms_v < 25e-3
