"""``adapt``: steps 2 and 3 of the thesis's identification, on captures."""

import json
from pathlib import Path

import numpy as np
import pytest

from bms_estimator.calibration.thesis import adapt
from bms_estimator.kernels.cell_model.chen_mora import r_s
from bms_estimator.model.cell import load_cell
from tests.calibration.simulated_load import TRUTH, capture, steps
from tests.command_line import run


@pytest.fixture
def table(tmp_path: Path) -> Path:
    """Write a capture of a simulated cell under steps of the current to a CSV file."""
    samples = capture(steps(0), seed=0)
    rows = np.column_stack([samples[name] for name in ("time_s", "current_a", "voltage_v")])
    path = tmp_path / "steps.csv"
    np.savetxt(path, rows, delimiter=",", header="time_s,current_a,voltage_v", comments="", fmt="%.6f")
    return path


def test_adapt_writes_a_cell_with_the_series_resistance_of_the_capture(table, tmp_path, capsys):
    out = tmp_path / "mine.toml"
    code, text, err = run(capsys, "adapt", table, "--cell", "ncr18650", "--out", out, "--json")
    assert (code, err) == (0, "")
    result, cell = json.loads(text), load_cell(out)
    assert set(result["a"]) == {f"a{i}" for i in range(1, 16)}
    assert result["a"]["a1"]["std"] is None
    assert result["a"]["a15"]["std"] > 0.0
    assert result["score_after_percent"] <= 1.05 * result["score_before_percent"]
    assert [cell.a[i] for i in range(1, 16)] == pytest.approx([result["a"][f"a{i}"]["value"] for i in range(1, 16)])
    assert cell.ladder is not None
    assert cell.ladder.error_v == pytest.approx(1e-3 * result["error_mv"])
    assert r_s(0.5, cell.a) == pytest.approx(r_s(0.5, TRUTH.a), rel=0.3)


def test_cell_file_with_worse_replays_is_not_written(table, tmp_path, capsys, monkeypatch):
    scores = iter([1.0, 9.0])  # before and after
    monkeypatch.setattr(adapt, "interval_score", lambda *_: next(scores))
    out = tmp_path / "worse.toml"
    code, text, err = run(capsys, "adapt", table, "--cell", "ncr18650", "--out", out)
    assert (code, text) == (2, "")
    assert "from 1.00 to 9.00 % of SOC" in err
    assert not out.exists()
