"""``capacity``: capacity from the rests of a capture, and errors of unusable captures."""

import json

import numpy as np
import pytest

from tests.calibration.simulated_load import TRUTH
from tests.calibration.simulated_relaxation import relaxation
from tests.cli.cell.test_ocv import save
from tests.command_line import error, run

CAPACITY_AH = TRUTH.cell.capacity_ah


@pytest.fixture
def capture(tmp_path):
    """Write a capture of a simulated cell with rests."""
    return save(tmp_path / "rests.csv", relaxation())


def test_json_has_capacity_and_anchors(capsys, capture):
    code, text, err = run(capsys, "capacity", capture, "--cell", "ncr18650", "--capacity-ah", "2.5", "--json")
    assert (code, err) == (0, "")
    result = json.loads(text)
    assert result["declared_ah"] == 2.5
    assert abs(result["capacity_ah"] - CAPACITY_AH) < 2.0 * result["capacity_std_ah"]
    assert result["capacity_std_ah"] < 0.1 * CAPACITY_AH
    assert len(result["anchors"]) >= 15
    assert {anchor["capture"] for anchor in result["anchors"]} == {"rests.csv"}
    errors = np.array([[anchor["off"], anchor["soc_std"]] for anchor in result["anchors"]])
    assert (np.abs(errors[:, 0]) < 3.0 * errors[:, 1]).all()


def test_capacity_is_more_certain_if_the_current_sensor_has_no_offset(capsys, capture):
    stds = []
    for offset in ("0.02", "0.0"):
        arguments = ("capacity", capture, "--cell", "ncr18650", "--current-offset-std-a", offset, "--json")
        stds.append(json.loads(run(capsys, *arguments)[1])["capacity_std_ah"])
    with_offset, without_offset = stds
    assert without_offset < 0.7 * with_offset


def test_table_shows_anchors_and_capacity(capsys, capture):
    code, text, _ = run(capsys, "capacity", capture, "--cell", "ncr18650")
    assert code == 0
    assert "15 min" in text
    assert "Ah, declared 3 Ah" in text


def test_current_in_milliamperes_is_detected(capsys, capture, tmp_path):
    rows = np.loadtxt(capture, delimiter=",", skiprows=1)
    rows[:, 1] *= 1e3
    wrong = tmp_path / "ma.csv"
    np.savetxt(wrong, rows, delimiter=",", header="time_s,current_a,voltage_v", comments="")
    err = error(run(capsys, "capacity", wrong, "--cell", "ncr18650"))
    assert "Ah, but 3 Ah is declared: is the current in amperes" in " ".join(err.split())


def test_capacity_of_a_real_cell_agrees_with_a_slow_discharge(capsys, shared_data):
    """The discharge of cell 1 at C/20 gave 2.99 Ah."""
    capture = shared_data / "ncr18650" / "cell1_hppc.csv.gz"
    arguments = ("capacity", capture, "--cell", "ncr18650", "--current-offset-std-a", "0.002", "--json")
    result = json.loads(run(capsys, *arguments)[1])
    assert abs(result["capacity_ah"] - 2.99) < 2.0 * result["capacity_std_ah"]
    assert result["capacity_std_ah"] < 0.15


def test_error_on_missing_rests_suggests_a_remedy(tmp_path, capsys):
    samples = relaxation()
    samples["current_a"] += 0.5
    capture = save(tmp_path / "loaded.csv", samples)
    code, text, err = run(capsys, "capacity", capture, "--cell", "ncr18650")
    assert (code, text) == (2, "")
    assert "error: no capacity: no two rests give an SOC" in err
    assert "rest the cell for half an hour" in err


def test_wrong_sign_of_the_current_is_detected(capsys, capture):
    err = error(run(capsys, "capacity", capture, "--cell", "ncr18650", "--current-sign", "charge_positive"))
    assert "check the sign of the current (--current-sign)" in err
    assert "rest" not in err.replace("the rests", "")  # no advice to rest the cell


@pytest.mark.parametrize(
    ("cell", "message"),
    [
        ("lto", "rests, at 3.322..4.160 V, are beyond the curve of the cell, 1.500..2.700 V: check the cell file"),
        (
            "lfp",
            "0.02 of SOC apart, the charge between them is 0.90 of the declared capacity: check the curve of the cell file",
        ),
        ("lmo", "anchors disagree by 5.3 times their expected errors: check the curve of the cell file"),
    ],
)
def test_wrong_cell_is_detected(capsys, capture, cell, message):
    err = error(run(capsys, "capacity", capture, "--cell", cell, "--capacity-ah", "3"))
    assert message in err
    assert "longer rests" not in err
    assert "rest again" not in err


def test_duplicate_capture_is_rejected(capsys, capture, tmp_path):
    other = tmp_path / "copy.csv"
    other.write_bytes(capture.read_bytes())
    err = error(run(capsys, "capacity", capture, other, "--cell", "ncr18650"))
    assert err == "error: rests.csv and copy.csv: the same samples; give each capture once\n"
