"""Verdicts of ``calibrate``, its page, ``validate`` and ``report`` on one capture: equal, and true where the reference is wrong."""

import json

import numpy as np
import pytest

from bms_estimator.model.cell import load_cell
from tests.calibration.simulated_load import TRUTH, capture, ladder_capture, steps
from tests.cli.captures.test_report import text_of, write_table
from tests.command_line import run

pytestmark = pytest.mark.usefixtures("empty_plots")

CAPACITY_AH = TRUTH.cell.capacity_ah
CELL = ("--cell", "ncr18650")


def good():
    """Return a capture of the cell ``ncr18650`` from SOC 98 % to 5 %."""
    return capture(steps())


def charge():
    """Return a discharge by 14,000 s of steps and a charge, which begin and end at SOC 98 %."""
    return capture(np.r_[steps(duration_s=14_000), np.full(15_400, -0.55), np.zeros(1800)])


def with_offset():
    """Return ``good`` by a sensor that measures 40 mA too much."""
    rows = good()
    rows["current_a"] += 0.04
    return rows


def cold():
    """Return a capture of 2 h at 0 °C."""
    return ladder_capture(steps(duration_s=7200), 0.0)


def after_a_gap(hours=3.0):
    """Return ``good`` with a gap in a rest."""
    rows = good()
    middle = np.flatnonzero((rows["time_s"] > 8000.0) & (rows["current_a"] == 0.0))[30]
    rows["time_s"][middle:] += 3600.0 * hours
    return rows


def in_series():
    """Return ``good`` of four cells in series."""
    rows = good()
    rows["voltage_v"] *= 4.0
    return rows


def verdicts(capsys, tmp_path, rows, *options):
    """Return the verdict of ``validate`` as JSON, and the sentences and the grade of the page of ``report``."""
    page = tmp_path / "page.html"
    validated = validate(capsys, tmp_path, rows, *options)
    code, printed, err = run(capsys, "report", tmp_path / "capture.csv", "--out", page, "--force", *options)
    assert code == 0, err
    return validated, printed.splitlines()[:-1], page_grade(page)


def validate(capsys, tmp_path, rows, *options):
    """Return the verdict of ``validate`` on samples as JSON."""
    path = write_table(tmp_path / "capture.csv", rows)
    code, out, err = run(capsys, "validate", path, "--json", *options)
    assert code == 0, err
    return json.loads(out)


def page_grade(page):
    """Return the grade that a page shows; None without a grade."""
    shown = page.read_text(encoding="utf-8").partition('<div class="verdict ')[2].partition('"')[0]
    return None if shown == "given" else shown


@pytest.mark.parametrize(
    ("rows", "options", "grade"),
    [
        (after_a_gap, CELL, "good"),
        (cold, ("--cell", "nmc", "--capacity-ah", CAPACITY_AH), "poor"),
        (in_series, (*CELL, "--series", 4), "good"),
    ],
)
def test_the_grade_agrees_with_the_error_of_the_model(capsys, tmp_path, rows, options, grade):
    assert validate(capsys, tmp_path, rows(), *options)["grade"] == grade


@pytest.mark.parametrize(
    ("rows", "options", "remarks"),
    [
        (good, ("--capacity-ah", 0.92 * CAPACITY_AH), ("an SOC of -3 %", "--capacity-ah", "a capacity of about 3.")),
        (good, ("--capacity-ah", 1.2 * CAPACITY_AH), ("a capacity of about 2.9", "--capacity-ah")),
        (charge, ("--soc", 1.0), ("an SOC of about 98 % at the start (--soc)",)),
        (good, ("--soc", 0.93), ("an SOC of about 98 % at the start (--soc)",)),
        (with_offset, (), ("A lower (check the zero of the current sensor)",)),
    ],
    ids=["small capacity", "large capacity", "charge", "start", "offset"],
)
def test_an_error_of_the_reference_is_not_blamed_on_the_model(capsys, tmp_path, rows, options, remarks):
    validated = validate(capsys, tmp_path, rows(), *CELL, *options)
    assert validated["grade"] is None
    assert [remark for remark in remarks if remark not in validated["verdict"]] == []
    assert not any(word in validated["verdict"] for word in ("good", "fair", "poor", "estimated SOC"))


def test_a_counted_soc_above_102_percent_is_remarked(capsys, tmp_path):
    rows = charge()
    rows["current_a"][rows["current_a"] < 0.0] *= 1.06
    validated = validate(capsys, tmp_path, rows, *CELL)
    assert 1.02 < validated["final_soc"] < 1.06
    assert f"Coulomb counting gives an SOC of {100.0 * validated['final_soc']:.0f} %" in validated["verdict"]


def test_a_start_on_a_plateau_gives_no_grade_of_the_soc(capsys, tmp_path):
    cell = load_cell("lfp", 3.0)
    rows = capture(steps(duration_s=4000), cell=cell.model_copy(update={"ladder": None}), soc=0.6)
    options = ("--cell", "lfp", "--capacity-ah", 3)
    validated = validate(capsys, tmp_path, rows, *options)
    assert "does not determine its SOC at the start" in validated["verdict"]
    assert "The estimated SOC" not in validated["verdict"]
    assert "The estimated SOC" in validate(capsys, tmp_path, rows, *options, "--soc", 0.6)["verdict"]


def test_a_wrong_sign_gives_no_verdict(capsys, tmp_path):
    rows = good()
    rows["current_a"] *= -1.0
    path = write_table(tmp_path / "capture.csv", rows)
    for command in ("validate", "report", "calibrate"):
        options = ("--out", tmp_path / "out") if command != "validate" else ()
        size = ("--capacity-ah", CAPACITY_AH)
        code, out, err = run(capsys, command, path, *CELL, *size, "--current-sign", "discharge_positive", *options)
        assert (code, out, "the current's sign is wrong" in err) == (2, "", True)


@pytest.mark.parametrize(
    ("rows", "cell"),
    [
        pytest.param(good, "ncr18650", marks=pytest.mark.thorough),
        (cold, "nmc"),
        pytest.param(with_offset, "ncr18650", marks=pytest.mark.thorough),
    ],
    ids=["good", "cold", "offset"],
)
def test_all_commands_give_the_grade_of_the_calibration_on_its_own_capture(capsys, tmp_path, rows, cell):
    path, out, page = write_table(tmp_path / "own.csv", rows()), tmp_path / "own.toml", tmp_path / "page.html"
    options = ("--cell", cell, "--capacity", CAPACITY_AH, "--out", out, "--report", page)
    code, printed, err = run(capsys, "calibrate", path, *options, "--json")
    assert code == 0, err
    calibrated = json.loads(printed)
    assert page_grade(page) == calibrated["grade"]
    text = text_of(page.read_text(encoding="utf-8"))
    sentences, _, unknown = calibrated["verdict"].partition("Not known")
    assert f"{sentences}{calibrated['validation']} Not known{unknown}" in text
    assert "The cell file was fitted to this capture" in text
    validated, reported, on_page = verdicts(capsys, tmp_path, rows(), "--cell", out)
    assert "The cell file was fitted to this capture" in validated["verdict"]
    assert validated["verdict"] == " ".join(reported)
    assert (validated["grade"], on_page) == (calibrated["grade"], calibrated["grade"])


@pytest.mark.thorough
def test_another_capture_is_not_called_fitted(capsys, tmp_path):
    out = tmp_path / "own.toml"
    path = write_table(tmp_path / "own.csv", good())
    assert run(capsys, "calibrate", path, *CELL, "--capacity", CAPACITY_AH, "--out", out)[0] == 0
    validated = validate(capsys, tmp_path, capture(steps(seed=3)), "--cell", out)
    assert "fitted" not in validated["verdict"]
    assert validated["grade"] == "good"
