"""Captures of the first version give the values of that version."""

import json
from pathlib import Path

import pytest

from bms_estimator import estimate, load_capture, load_cell

ROUNDING = 1e-9
"""Relative tolerance, because other processors round differently."""


def test_a_capture_of_the_first_version_gives_the_values_of_that_version(data: Path) -> None:
    recorded = data / "simulated" / "board_0_1_0.bms"
    then = json.loads(recorded.with_suffix(".json").read_text())
    now = estimate(load_capture(recorded), load_cell("chen_mora"))
    assert now.rows.size == then["samples"]
    for row, place in zip(then["rows"], (0, now.rows.size // 2, -1), strict=True):
        assert {name: float(now[name][place]) for name in row} == pytest.approx(row, rel=ROUNDING)
