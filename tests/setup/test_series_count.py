"""Number of cells in series from voltage and chemistry."""

import math
from pathlib import Path

import numpy as np
import pytest

from bms_estimator.estimator.settings_plausibility import Contradictions, implausible_measurement
from bms_estimator.model.cell import load_cell
from bms_estimator.setup.questions import cell_voltages, possible_counts, suggest_count
from bms_estimator.sources.captures.replay import load_capture

LEAF = Path(__file__).parents[1] / "data" / "leaf" / "cc_1c.csv.gz"
"""Charges and discharges of a cell of a Nissan Leaf, with rests."""


@pytest.mark.parametrize(
    ("cell", "voltage_v", "count"),
    [
        ("lfp", 13.2, 4),
        ("lfp", 26.4, 8),
        ("lfp", 52.8, 16),
        ("lfp", 56.8, 16),  # while it is charged
        ("nmc", 48.1, 13),
        ("nmc", 36.0, 10),
        ("nca", 3.7, 1),
        ("lto", 13.8, 6),
        ("nmc", 0.4, None),  # below one cell
    ],
)
def test_usual_packs_are_recognized(cell: str, voltage_v: float, count: int | None) -> None:
    assert suggest_count(voltage_v, cell_voltages(cell)) == count


def test_possible_counts_end_where_a_cell_would_be_outside_its_voltages() -> None:
    cell = cell_voltages("lfp")
    counts = possible_counts(52.8, cell)
    assert 52.8 / counts.start <= cell.max_v < 52.8 / (counts.start - 1)
    assert 52.8 / (counts.stop - 1) >= cell.min_v > 52.8 / counts.stop


@pytest.mark.parametrize(
    ("cell", "series", "voltage_v", "current_a", "text"),
    [
        ("lfp", 16, 52.8, 0.0, ""),
        ("lfp", 16, 54.0, 0.0, ""),
        ("lfp", 16, 56.8, -50.0, ""),
        ("lfp", 16, 44.8, 100.0, ""),
        ("lfp", 15, 52.8, 0.0, "52.80 V are 3.52 V a cell"),
        ("lfp", 15, 56.0, 0.0, "3.73 V a cell"),
        ("lfp", 8, 52.8, 50.0, "16 in series is likely"),
        ("nmc", 14, 46.2, 0.0, "3.30 V a cell is what LFP has at rest"),
        ("nmc", 14, 46.2, 30.0, ""),
        ("nmc", 14, 51.8, 0.0, ""),
        ("lfp", 15, math.nan, math.nan, ""),
    ],
)
def test_a_voltage_that_the_cells_cannot_have_is_reported(
    cell: str, series: int, voltage_v: float, current_a: float, text: str
) -> None:
    lines = implausible_measurement(load_cell(cell, 100.0).pack(series, 1), voltage_v, current_a, math.nan)
    assert len(lines) == bool(text)
    assert text in "".join(lines)


def test_a_contradiction_lasts_until_a_voltage_at_rest_agrees_with_the_settings() -> None:
    contradictions, names = Contradictions(load_cell("lfp", 100.0).pack(15, 1)), []
    for time_s, values in enumerate(
        (
            (math.nan, 0.0, math.nan),
            (53.8, 0.0, math.nan),  # just charged
            (50.0, 30.0, 200.0),  # the device reports its capacity; a load proves nothing
            (53.8, 0.0, math.nan),
            (49.8, 0.0, math.nan),
            (49.8, 0.0, 100.0),
        )
    ):
        contradictions.add(time_s, *values)
        names.append([text.split()[0] for text in contradictions.texts])
    series, capacity = ["pack.series"], ["pack.capacity_ah:"]
    assert names == [[], series, series + capacity, series + capacity, capacity, []]


DISCHARGE, CHARGE = (0.5, 60, 51.2), (-0.5, 60, 54.4)
"""Current [C], duration [min] and voltage of 16 LFP cells in series [V]."""


@pytest.mark.parametrize(
    ("cell", "series", "steps", "reported"),
    [
        ("lfp", 16, [DISCHARGE, (0.0, 20, 52.8), CHARGE, (-0.02, 20, 57.0), DISCHARGE, (0.0, 20, 54.1)], []),
        ("lfp", 16, [(1.0, 40, 42.0), (0.0, 20, 33.6)], []),  # empty
        ("lfp", 15, [DISCHARGE, (0.0, 9, 52.8)], []),  # not at rest long enough
        ("lfp", 15, [DISCHARGE, (0.0, 20, 52.8), DISCHARGE, (0.0, 20, 52.7)], ["pack.series"]),
        ("nmc", 14, [DISCHARGE, (0.0, 20, 46.9)], []),  # nearly empty is possible
        ("nmc", 14, [DISCHARGE, CHARGE, (0.0, 20, 46.9)], ["pack.series"]),
        ("nmc", 14, [DISCHARGE, CHARGE, (math.nan, 1, 46.9), (0.0, 20, 46.9)], []),  # unknown charge
    ],
)
def test_a_wrong_cell_or_number_of_cells_is_found_at_rest_after_a_load(
    cell: str, series: int, steps: list[tuple[float, int, float]], reported: list[str]
) -> None:
    """Under load each of these voltages is possible."""
    contradictions = Contradictions(load_cell(cell, 100.0).pack(series, 1))
    rows = [(voltage_v, 100.0 * current_c, math.nan) for current_c, minutes, voltage_v in steps for _ in range(minutes)]
    lines = [line for minute, row in enumerate(rows) for line in contradictions.add(60.0 * minute, *row)]
    assert [line.split()[0] for line in lines] == reported
    assert contradictions.texts == lines


@pytest.mark.parametrize(("cell", "reported"), [("lmo", {False}), ("lfp", {False, True})])
def test_a_wrong_cell_of_a_real_pack_is_found_at_rest_after_a_start_under_charge(
    cell: str, reported: set[bool]
) -> None:
    capture = load_capture(LEAF)
    rows = np.column_stack([capture[name] for name in ("time_s", "voltage_v", "current_a")])
    contradictions = Contradictions(load_cell(cell, 30.5).pack(1, 1))
    results = [bool(contradictions.add(*row, math.nan)) for row in rows[np.argmax(rows[:, 2] < -10.0) :].tolist()]
    assert (results[0], set(results)) == (False, reported)
