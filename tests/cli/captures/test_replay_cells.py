"""Estimates of single cells in the results of ``replay``."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from bms_estimator.sources.captures.raw_capture import CaptureHeader, CaptureWriter
from bms_estimator.telemetry.cells import CELL_COLUMNS
from tests.command_line import run

OHM = 0.01
"""Resistance of a cell [ohm]."""
LOW_V = 0.05
"""Voltage of the second cell below the other two [V]."""
SAMPLES = 600
"""Number of samples of the recording, at 1 Hz."""


@pytest.fixture
def pack(tmp_path: Path) -> Path:
    """Write the settings of a pack of three cells, whose board prints text."""
    path = tmp_path / "pack.toml"
    path.write_text("[pack]\ncell = 'nmc'\ncapacity_ah = 10\nseries = 3\n[sensor]\nprotocol = 'text'\n")
    return path


def recorded(folder: Path, *, with_cells: bool) -> Path:
    """Record lines with a current of 1 A in every other minute."""
    path = folder / "cells.bms"
    with CaptureWriter(path, CaptureHeader(mode="text")) as writer:
        for time_s in range(SAMPLES):
            current_a = float(time_s // 60 % 2)
            cells_v = 3.7 - OHM * current_a - LOW_V * np.array([0.0, 1.0, 0.0])
            cells = f" cells={','.join(f'{each:.3f}' for each in cells_v)}" if with_cells else ""
            writer.write(float(time_s), f"V={cells_v.sum():.3f} I={current_a}{cells}\n".encode())
    return path


def test_the_table_and_the_summary_have_the_weakest_cell_and_all_cells(
    pack: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.csv"
    code, text, err = run(capsys, "replay", recorded(tmp_path, with_cells=True), "--pack", pack, "--out", out, "--json")
    assert (code, err) == (0, "")
    rows, result = list(csv.DictReader(out.read_text().splitlines())), json.loads(text)
    assert rows[0]["weakest_cell"] == "nan"  # before the end of the first window
    assert float(rows[-1]["weakest_cell"]) == result["weakest_cell"] == 2
    for name in CELL_COLUMNS.names or ():
        assert float(rows[-1][name]) == result[name]
    assert [cell["number"] for cell in result["cells"]] == [1, 2, 3]
    assert result["cells"][1]["soc_deviation"] < -0.02


def test_values_of_the_cells_are_equal_with_and_without_a_table(
    pack: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capture = recorded(tmp_path, with_cells=True)
    _, with_table, _ = run(capsys, "replay", capture, "--pack", pack, "--out", tmp_path / "out.csv", "--json")
    _, without_table, _ = run(capsys, "replay", capture, "--pack", pack, "--json")
    assert json.loads(with_table)["cells"] == json.loads(without_table)["cells"]


def test_the_terminal_shows_the_cells_with_the_weakest_first(
    pack: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, text, _ = run(capsys, "replay", recorded(tmp_path, with_cells=True), "--pack", pack)
    assert code == 0
    lines = text[text.index("self-discharge") :].splitlines()
    assert next(line.split()[0] for line in lines if "mA" in line) == "2"


@pytest.mark.parametrize("command", ["replay", "alarms"])
def test_a_wrong_number_of_cells_is_named_as_the_reason_for_no_values_of_cells(
    pack: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    pack.write_text(pack.read_text().replace("series = 3", "series = 5"))
    code, text, err = run(capsys, command, recorded(tmp_path, with_cells=True), "--pack", pack, "--json")
    assert code == 0
    assert "no estimates of single cells: 3 cells are measured, but the pack has 5 in series" in err
    assert not json.loads(text).get("cells")


def test_a_capture_without_cell_voltages_has_no_values_of_cells(
    pack: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.csv"
    code, text, _ = run(capsys, "replay", recorded(tmp_path, with_cells=False), "--pack", pack, "--out", out, "--json")
    assert code == 0
    assert "weakest_cell" not in out.read_text().splitlines()[0]
    assert json.loads(text)["cells"] == []
    assert json.loads(text)["weakest_cell"] is None


@pytest.mark.parametrize("name", ["cells.csv", "cells.parquet"])
def test_a_converted_capture_gives_the_same_estimates_of_the_cells(
    pack: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    capture = recorded(tmp_path, with_cells=True)
    assert run(capsys, "convert", capture, "--out", tmp_path / name)[0] == 0
    _, recorded_text, _ = run(capsys, "replay", capture, "--pack", pack, "--json")
    _, converted_text, _ = run(capsys, "replay", tmp_path / name, "--pack", pack, "--json")
    assert json.loads(converted_text)["cells"] == json.loads(recorded_text)["cells"] != []
