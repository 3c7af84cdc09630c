"""``ocv``: OCV curves from rests, slow discharges and tables, and errors of unusable captures."""

import json

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator

from bms_estimator.model.cell import load_cell
from bms_estimator.model.cell_sections import ChenMoraOcv, TableOcv
from tests.calibration.simulated_relaxation import INVALID_CAPTURES, relaxation
from tests.command_line import error, run


def save(path, samples):
    """Write samples to a CSV file. Return its path."""
    rows = np.column_stack([samples[name] for name in ("time_s", "current_a", "voltage_v")])
    np.savetxt(path, rows, delimiter=",", header="time_s,current_a,voltage_v", comments="", fmt="%.6f")
    return path


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    """Write two relaxation tests of a simulated cell to files."""
    folder = tmp_path_factory.mktemp("relaxation")
    return [save(folder / f"run{seed}.csv", relaxation(seed=seed)) for seed in (0, 1)]


@pytest.mark.parametrize(("form", "limit_mv"), [("chen-mora", 10.0), ("table", 2.0)])
def test_curve_of_a_real_cell_fits_the_voltages_of_its_rests(tmp_path, capsys, shared_data, form, limit_mv):
    out = tmp_path / "cell5.toml"
    capture = shared_data / "ncr18650" / "cell5_relaxation_c2.csv.gz"
    code, text, err = run(capsys, "ocv", capture, "--capacity-ah", "3.0", "--form", form, "--out", out, "--json")
    assert (code, err) == (0, "")
    result = json.loads(text)
    assert result["form"] == form
    assert result["points"] == len(result["soc"]) == len(result["ocv_v"]) == len(result["std_v"]) >= 18
    assert result["soc"] == sorted(result["soc"])
    assert result["soc"][0] < 0.1
    assert result["soc"][-1] > 0.9
    assert 0.0 <= result["rms_mv"] <= limit_mv
    assert result["rms_mv"] <= result["max_mv"]
    assert max(result["std_v"]) < 0.01

    cell = load_cell(out)
    assert cell.cell.name == "cell5"
    assert cell.cell.capacity_ah == 3.0
    assert cell.cell.capacity_std is None
    soc, ocv_v = np.array(result["soc"]), np.array(result["ocv_v"])
    if form == "chen-mora":
        assert list(result["parameters"]) == ["a16", "a17", "a18", "a19", "a20", "a21"]
        assert all(set(parameter) == {"value", "std"} for parameter in result["parameters"].values())
        assert isinstance(cell.ocv, ChenMoraOcv)
        a16, a17, a18, a19, a20, a21 = (result["parameters"][f"a{i}"]["value"] for i in range(16, 22))
        assert cell.ocv.a == pytest.approx((a16, a17, a18, a19, a20, a21), rel=1e-6)
        expected_v = -a16 * np.exp(-a17 * soc) + a18 + a19 * soc - a20 * soc**2 + a21 * soc**3  # (2.10) of the thesis
        assert 1e3 * np.sqrt(np.mean((ocv_v - expected_v) ** 2)) == pytest.approx(result["rms_mv"], rel=1e-6)
        assert 1e3 * np.abs(ocv_v - expected_v).max() == pytest.approx(result["max_mv"], rel=1e-6)
    else:
        assert result["parameters"] == {}
        assert isinstance(cell.ocv, TableOcv)
        assert PchipInterpolator(cell.ocv.soc, cell.ocv.ocv_v)(soc) == pytest.approx(ocv_v, abs=3e-3)
        assert cell.ocv.error_v is not None
        assert 1e-3 < np.median(cell.ocv.error_v) < 0.01
        assert (np.diff(cell.ocv.ocv_v) > 0.0).all()


def test_several_captures_are_fitted_jointly(captures, tmp_path, capsys):
    out = tmp_path / "paired.toml"
    code, text, _ = run(capsys, "ocv", *captures, "--capacity-ah", "3", "--form", "table", "--out", out, "--json")
    assert code == 0
    result = json.loads(text)
    assert result["points"] == 40
    assert {name: source["rests"] for name, source in result["captures"].items()} == {"run0.csv": 20, "run1.csv": 20}
    cell = load_cell(out)
    assert cell.cell.series_count == 1
    assert "OCV: 20 rests of run0.csv, 20 rests of run1.csv" in out.read_text()
    # circuit elements are estimated roughly from the rests; at SOC 0.5 the true R_s is 86.1 mohm and the true R_tl about 20 mohm
    assert cell.r_s.offset_ohm == pytest.approx(0.0861, rel=0.15)
    assert 0.01 < cell.r_tl.offset_ohm < 0.05


def test_table_shows_the_result(captures, tmp_path, capsys):
    out = tmp_path / "c.toml"
    code, text, _ = run(capsys, "ocv", captures[0], "--capacity-ah", "3", "--out", out)
    assert code == 0
    for words in ("points", "SOC 0.050 to 1.000", "relaxation after a rest", "mV RMS", "error of the curve"):
        assert words in text
    _, text, _ = run(
        capsys, "ocv", captures[0], "--capacity-ah", "3", "--form", "chen-mora", "--out", tmp_path / "d.toml"
    )
    assert "a16" in text
    assert "a21" in text


def test_number_of_cells_is_estimated_from_the_voltage(tmp_path, capsys):
    samples = relaxation()
    samples["voltage_v"] *= 6.0
    code, text, _ = run(
        capsys,
        "ocv",
        save(tmp_path / "pack.csv", samples),
        "--capacity-ah",
        "3",
        "--out",
        tmp_path / "p.toml",
        "--json",
    )
    assert code == 0
    assert json.loads(text)["series_count"] == 6
    assert load_cell(tmp_path / "p.toml").cell.series_count == 6


@pytest.mark.parametrize("fault", INVALID_CAPTURES)
def test_invalid_input_ends_with_code_2(tmp_path, capsys, fault):
    make_samples, capacity_ah, message = INVALID_CAPTURES[fault]
    capture, out = save(tmp_path / "bad.csv", make_samples()), tmp_path / "c.toml"
    code, text, err = run(capsys, "ocv", capture, "--capacity-ah", capacity_ah, "--out", out)
    assert (code, text) == (2, "")
    assert " ".join(message.split()) in " ".join(err.split())
    assert "Traceback" not in err
    assert fault == "span" or "bad.csv: " in err  # the SOC span is that of all captures together
    assert not out.exists()


@pytest.mark.parametrize(
    ("distort", "options", "message"),
    [
        (
            lambda voltage_v: 0.0 * voltage_v + 3.7,
            (),
            "bad.csv: the voltage is 3.7 V throughout: is the sensor connected?",
        ),
        (
            lambda voltage_v: 1e3 * voltage_v,
            (),
            "cells in series; if the column is in millivolts, convert it to volts, otherwise give --series",
        ),
        (lambda voltage_v: voltage_v, ("--series", 4), "V per cell"),
    ],
    ids=["dead", "millivolts", "too many cells"],
)
def test_implausible_voltage_is_rejected(distort, options, message, tmp_path, capsys):
    samples = relaxation()
    samples["voltage_v"] = distort(samples["voltage_v"])
    capture, out = save(tmp_path / "bad.csv", samples), tmp_path / "c.toml"
    err = error(run(capsys, "ocv", capture, "--capacity-ah", "3", *options, "--out", out))
    assert message in " ".join(err.split())
    assert not out.exists()


def test_capture_is_not_overwritten(captures, capsys):
    before = captures[0].read_bytes()
    assert "is also an input" in error(
        run(capsys, "ocv", captures[0], "--capacity-ah", "3", "--out", captures[0], "--force")
    )
    assert captures[0].read_bytes() == before


def test_missing_output_folder_is_an_error(captures, tmp_path, capsys):
    err = error(run(capsys, "ocv", captures[0], "--capacity-ah", "3", "--out", tmp_path / "no" / "c.toml"))
    assert "Traceback" not in err
    err = error(run(capsys, "ocv", tmp_path / "absent.csv", "--capacity-ah", "3", "--out", tmp_path / "c.toml"))
    assert "absent.csv" in err


def test_empty_capture_is_an_error(tmp_path, capsys):
    empty = tmp_path / "empty.csv"
    empty.write_text("time_s,current_a,voltage_v\n")
    err = error(run(capsys, "ocv", empty, "--capacity-ah", "3", "--out", tmp_path / "c.toml"))
    assert "Traceback" not in err
    assert "empty.csv" in err


def test_capture_without_numbers_is_an_error(tmp_path, capsys):
    samples = relaxation(rounds=1)
    samples["voltage_v"] = np.nan
    capture = save(tmp_path / "nan.csv", samples)
    err = error(run(capsys, "ocv", capture, "--capacity-ah", "3", "--out", tmp_path / "c.toml"))
    assert err == f"error: nan.csv: none of {samples.size} samples has finite time, current and voltage\n"


def test_sign_of_the_current_is_an_option(tmp_path, capsys):
    samples = relaxation()
    samples["current_a"] *= -1.0
    arguments = ("ocv", save(tmp_path / "charge.csv", samples), "--capacity-ah", "3", "--out", tmp_path / "c.toml")
    assert "discharge must be positive (--current-sign)" in error(run(capsys, *arguments))
    assert run(capsys, *arguments, "--current-sign", "charge_positive")[0] == 0
    assert "20 rests of charge.csv" in (tmp_path / "c.toml").read_text()


def test_a_given_temperature_coefficient_is_written_to_the_cell_file(tmp_path, capsys):
    curve, out = tmp_path / "curve.csv", tmp_path / "cell.toml"
    rows = [f"{soc:.2f},{3.0 + 1.2 * soc:.4f},{1e-4 * (2.0 * soc - 1.0):.3g}" for soc in np.linspace(0.0, 1.0, 21)]
    curve.write_text("\n".join(["soc,ocv_v,per_kelvin_v", *rows]))
    assert run(capsys, "ocv", curve, "--capacity-ah", "3", "--out", out)[0] == 0
    ocv = load_cell(out).ocv
    assert ocv.per_kelvin_v == pytest.approx(1e-4 * (2.0 * np.array(ocv.soc) - 1.0), abs=1e-9)


def test_kinds_of_captures_are_recognized_and_combined_to_one_curve(tmp_path, capsys, data):
    """The captures are a slow discharge and a tabulated curve with hysteresis."""
    out = tmp_path / "m50.toml"
    folder = data / "lgm50"
    arguments = ("ocv", folder / "rate_0p1c_25c.csv.gz", folder / "ocv_25c.csv", "--out", out)
    code, text, _ = run(capsys, *arguments, "--json")
    assert code == 0
    result = json.loads(text)
    assert [source["kind"] for source in result["sources"]] == ["C/10 discharge, 4.945 Ah", "given curve, 101 points"]
    assert result["capacity_ah"] == result["capacity_measured_ah"] == pytest.approx(4.945, abs=1e-3)
    cell = load_cell(out)
    assert cell.cell.capacity_std == 0.03
    ocv = cell.ocv
    assert ocv.hysteresis_v is not None
    assert ocv.per_kelvin_v is None
    given = np.loadtxt(folder / "ocv_25c.csv", delimiter=",", skiprows=1)
    inside = (given[:, 0] > 0.1) & (given[:, 0] < 0.95)
    assert PchipInterpolator(ocv.soc, ocv.ocv_v)(given[inside, 0]) == pytest.approx(given[inside, 1], abs=8e-3)
    _, text, _ = run(capsys, *arguments, "--force")
    for words in (
        "C/10 discharge, 4.945 Ah",
        "given curve, 101 points",
        "recognized as",
        "Circuit elements: those of the generic nca",
    ):
        assert words in text + out.read_text()


@pytest.mark.parametrize("direction", ["dis", pytest.param("chg", marks=pytest.mark.thorough)])
def test_unpaired_slow_curve_of_lfp_is_centered_on_the_hysteresis(tmp_path, capsys, shared_data, direction):
    """On a plateau, the hysteresis corresponds to 0.1 of SOC or more, so the curve is shifted by the hysteresis of the generic
    cell."""
    folder, out, pair = shared_data / "a123", tmp_path / "lone.toml", tmp_path / "pair.toml"
    files = {name: folder / f"c30_{name}_p25.csv.gz" for name in ("dis", "chg")}
    for captures, cell_file in (([files[direction]], out), (list(files.values()), pair)):
        assert run(capsys, "ocv", *captures, "--capacity-ah", "2.05", "--out", cell_file)[0] == 0
    unpaired, paired = load_cell(out).ocv, load_cell(pair).ocv
    inside = (np.array(paired.soc) > 0.15) & (np.array(paired.soc) < 0.95)
    deviation_v = np.abs(np.array(unpaired.ocv_v) - np.array(paired.ocv_v))[inside]
    assert (deviation_v < 2.0 * np.array(unpaired.error_v)[inside]).mean() > 0.95
    assert unpaired.hysteresis_v == pytest.approx(np.full(len(unpaired.soc), 0.01))
    assert "Hysteresis: that of the generic lfp" in out.read_text()
    assert "Hysteresis" not in pair.read_text()
    assert "Circuit elements: those of the generic lfp" in out.read_text()


def test_unpaired_slow_curve_of_a_layered_oxide_is_corrected(tmp_path, capsys, data):
    """The LG M50's discharge at C/10 is on average 17 mV below the published curve. The correction for the RC pairs halves that."""
    out, folder = tmp_path / "lone.toml", data / "lgm50"
    code, text, _ = run(capsys, "ocv", folder / "rate_0p1c_25c.csv.gz", "--out", out)
    assert code == 0
    assert "subtracted for" in text
    ocv = load_cell(out).ocv
    assert ocv.hysteresis_v is None
    published = np.genfromtxt(folder / "ocv_25c.csv", delimiter=",", names=True)
    soc = np.linspace(0.15, 0.95, 81)
    deviation_v = np.interp(soc, ocv.soc, ocv.ocv_v) - np.interp(soc, published["soc"], published["ocv_v"])
    assert abs(deviation_v.mean()) < 5e-3
    assert np.sqrt(np.mean(deviation_v**2)) < 10e-3
    # resistances with weak temperature dependence
    ladder, generic = load_cell(out).ladder, load_cell("nca", 4.945).ladder
    assert np.array(ladder.weak_ohm) == pytest.approx(np.array(generic.weak_ohm), rel=1e-3)


def test_curve_that_falls_to_0_v_is_rejected(tmp_path, capsys, shared_data):
    """With a declared capacity of 4 Ah instead of 2.9 Ah, the points end far from empty."""
    capture = shared_data / "panasonic18650pf" / "25_hppc.csv.gz"
    assert "at SOC 0: give captures down to empty; if the cell was emptied, the capacity of 4 Ah is too large" in error(
        run(capsys, "ocv", capture, "--capacity-ah", "4", "--out", tmp_path / "large.toml")
    )
    assert not (tmp_path / "large.toml").exists()


def test_declared_error_of_the_curve_of_a_pouch_cell_is_largest_near_empty(tmp_path, capsys, data):
    out = tmp_path / "leaf.toml"
    code, text, _ = run(
        capsys, "ocv", data / "leaf" / "hppc_25c_from_full.csv.gz", "--capacity-ah", "30.5", "--out", out, "--json"
    )
    assert code == 0
    result = json.loads(text)
    assert result["sources"][0]["kind"] == "10 rests"
    assert result["error_mv"][0] > 3.0 * np.median(result["error_mv"])


def test_captures_of_equal_names_are_distinguished(captures, tmp_path, capsys):
    other = tmp_path / captures[0].name
    other.write_bytes(captures[1].read_bytes())
    code, text, _ = run(
        capsys, "ocv", captures[0], other, "--capacity-ah", "3", "--out", tmp_path / "two.toml", "--json"
    )
    assert code == 0
    assert set(json.loads(text)["captures"]) == {str(captures[0]), str(other)}
