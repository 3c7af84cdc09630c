"""Number of cells in series from voltage and chemistry."""

import math

import pytest

from bms_estimator.estimator.settings_plausibility import Contradictions, implausible_measurement
from bms_estimator.model.cell import load_cell
from bms_estimator.setup.questions import cell_voltages, possible_counts, suggest_count


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
    for voltage_v, current_a, device_ah in (
        (math.nan, 0.0, math.nan),
        (53.8, 0.0, math.nan),  # just charged
        (50.0, 30.0, 200.0),  # the device reports its capacity; a load proves nothing
        (53.8, 0.0, math.nan),
        (49.8, 0.0, math.nan),
        (49.8, 0.0, 100.0),
    ):
        contradictions.add(voltage_v, current_a, device_ah)
        names.append([text.split()[0] for text in contradictions.texts])
    series, capacity = ["pack.series"], ["pack.capacity_ah:"]
    assert names == [[], series, series + capacity, series + capacity, capacity, []]
