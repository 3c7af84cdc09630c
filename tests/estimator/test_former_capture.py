"""Regression test: the estimate from a capture of version 0.1.0 equals that of version 0.1.0."""

import json
from pathlib import Path

import pytest

from bms_estimator.estimator.estimator import estimate
from bms_estimator.model.cell import load_cell
from bms_estimator.sources.captures.replay import load_capture

ROUNDING = 1e-9
"""Relative tolerance for the different rounding of other processors."""


def test_the_estimate_from_a_capture_of_version_0_1_0_is_unchanged(data: Path) -> None:
    path = data / "simulated" / "board_0_1_0.bms"
    expected = json.loads(path.with_suffix(".json").read_text())
    trace = estimate(load_capture(path), load_cell("chen_mora"))
    assert trace.rows.size == expected["samples"]
    for row, index in zip(expected["rows"], (0, trace.rows.size // 2, -1), strict=True):
        assert {name: float(trace[name][index]) for name in row} == pytest.approx(row, rel=ROUNDING)
