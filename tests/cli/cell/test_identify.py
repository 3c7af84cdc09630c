"""``identify`` and ``validate``: identified cell files, their validation, and errors of unusable captures."""

import json

import numpy as np
import pytest

from bms_estimator.calibration.elements import identify
from bms_estimator.kernels.cell_model.chen_mora import r_s
from bms_estimator.model.cell import load_cell
from tests.calibration.simulated_load import TRUTH, capture, steps
from tests.command_line import error, run

ERROR_KEYS = ["samples", "voltage_rms_mv", "mean_abs_percent", "max_abs_percent"]


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    """Write two captures of a simulated cell under steps of the current. Return their folder."""
    folder = tmp_path_factory.mktemp("captures")
    for seed in (0, 7):
        samples = capture(steps(seed), seed=seed)
        rows = np.column_stack([samples[name] for name in ("time_s", "current_a", "voltage_v")])
        np.savetxt(
            folder / f"steps{seed}.csv",
            rows,
            delimiter=",",
            header="time_s,current_a,voltage_v",
            comments="",
            fmt="%.6f",
        )
    return folder


def test_identify_writes_a_cell_that_validates_on_another_capture(tables, tmp_path, capsys):
    out = tmp_path / "mine.toml"
    code, text, _ = run(capsys, "identify", tables / "steps0.csv", "--cell", "ncr18650", "--out", out, "--json")
    result = json.loads(text)
    assert code == 0
    assert result["elements"][1]["soc"] == 0.5
    assert {"r_s_ohm", "r_s_ohm_std", "r_tl_ohm"} <= set(result["elements"][1])
    assert result["temperature_c"] == [25.0, 25.0]
    assert result["captures"][0]["initial_soc"] == pytest.approx(0.98, abs=0.005)
    assert result["captures"][0]["temperature_c"] is None
    assert result["captures"][0]["held_back"] is False
    assert result["score_after_percent"] <= 1.05 * result["score_before_percent"]
    assert {"left_out", "ocv_correction_rms_mv", "error_mv", "seconds"} <= set(result)

    cell = load_cell(out)
    assert cell.cell.name == "mine"
    assert cell.ladder.temperature_c == (25.0, 25.0)
    assert r_s(0.5, cell.a) == pytest.approx(result["elements"][1]["r_s_ohm"], rel=0.1)
    code, text, err = run(capsys, "validate", tables / "steps7.csv", "--cell", out, "--json")
    validated = json.loads(text)
    assert (code, err) == (0, "")
    assert set(ERROR_KEYS) | {f"{key}_soc_above_0_1" for key in ERROR_KEYS} <= set(validated)
    assert validated["voltage_rms_mv_soc_above_0_1"] < 10.0
    assert validated["initial_soc"] == pytest.approx(0.98, abs=0.005)
    assert validated["initial_soc_from"] == "first rest"


def test_identify_and_validate_print_their_results_as_tables(tables, tmp_path, capsys):
    captures = [tables / "steps0.csv", tables / "steps7.csv"]
    code, text, _ = run(capsys, "identify", *captures, "--cell", "ncr18650", "--out", tmp_path / "c.toml", "--keep-ocv")
    assert code == 0
    assert "r_tl [mohm]" in text
    assert "held back" in text
    assert "interval score" in text
    assert "steps7" in text
    assert load_cell(tmp_path / "c.toml").ocv == TRUTH.ocv
    assert "# Resistances identified from steps0.csv" in (tmp_path / "c.toml").read_text()
    code, text, _ = run(capsys, "validate", tables / "steps0.csv", "--cell", "ncr18650", "--soc", "0.9")
    assert code == 0
    assert "SOC 0.9000 (given)" in text


def test_user_errors_end_with_code_2(tables, tmp_path, capsys):
    rows = np.loadtxt(tables / "steps0.csv", delimiter=",", skiprows=1) * [1, -1, 1]  # negates the current
    flipped = tmp_path / "flipped.csv"
    np.savetxt(flipped, rows, delimiter=",", header="time_s,current_a,voltage_v", comments="")
    code, text, err = run(capsys, "identify", flipped, "--cell", "ncr18650", "--out", tmp_path / "c.toml")
    assert (code, text) == (2, "")
    assert "flipped.csv: the current's sign is wrong" in err
    assert not (tmp_path / "c.toml").exists()
    code, text, err = run(capsys, "validate", flipped, "--cell", "ncr18650", "--json")
    assert (code, text) == (2, "")
    assert "error: flipped.csv: the current's sign is wrong" in err
    assert "error: flipped.csv: SOC runs from 0.98" in err
    err = error(run(capsys, "identify", flipped, "--cell", "ncr18650", "--out", flipped, "--force"))
    assert "is also an input" in err


@pytest.mark.thorough
def test_sign_of_the_current_is_an_option(tables, tmp_path, capsys):
    rows = np.loadtxt(tables / "steps7.csv", delimiter=",", skiprows=1) * [1, -1, 1]  # negates the current
    flipped = tmp_path / "flipped.csv"
    np.savetxt(flipped, rows, delimiter=",", header="time_s,current_a,voltage_v", comments="")
    result = run(capsys, "validate", tables / "steps7.csv", "--cell", "ncr18650", "--json")
    result_of_flipped = run(
        capsys, "validate", flipped, "--cell", "ncr18650", "--json", "--current-sign", "charge_positive"
    )
    assert result_of_flipped == result
    for name, table, sign in (
        ("first.toml", tables / "steps7.csv", "discharge_positive"),
        ("second.toml", flipped, "charge_positive"),
    ):
        arguments = (table, "--cell", "ncr18650", "--out", tmp_path / name, "--current-sign", sign)
        assert run(capsys, "identify", *arguments)[0] == 0
    assert load_cell(tmp_path / "first.toml").ladder == load_cell(tmp_path / "second.toml").ladder


def test_cell_file_with_worse_replays_is_not_written(tables, tmp_path, capsys, monkeypatch):
    # before the fit, after a fit with the given OCV, and after a fit with a corrected OCV
    scores = iter([1.0, 9.0, 9.0])
    monkeypatch.setattr(identify, "interval_score", lambda *_: next(scores))
    out = tmp_path / "worse.toml"
    code, text, err = run(capsys, "identify", tables / "steps0.csv", "--cell", "ncr18650", "--out", out)
    assert (code, text) == (2, "")
    assert "replays that start in mid-load get worse" in err
    assert "from 1.00 to 9.00 % of SOC" in err
    assert not out.exists()


@pytest.mark.thorough
def test_a_file_from_pulses_and_a_drive_is_written(tmp_path, capsys, shared_data):
    """A fit to the pulses alone makes replays of the drive worse. The file that is fitted to both improves them."""
    pulses, drive = (shared_data / "panasonic18650pf" / f"25_{name}.csv.gz" for name in ("hppc", "us06"))
    assert run(capsys, "ocv", pulses, "--capacity-ah", "2.9", "--out", tmp_path / "ocv.toml")[0] == 0
    assert not run(capsys, "identify", pulses, drive, "--cell", tmp_path / "ocv.toml", "--out", tmp_path / "own.toml")[
        0
    ]
