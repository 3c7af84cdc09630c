"""Number of cells in series from voltage and chemistry."""

import pytest

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
    ],
)
def test_usual_packs_are_recognized(cell: str, voltage_v: float, count: int) -> None:
    assert suggest_count(voltage_v, cell_voltages(cell)) == count


def test_no_count_is_suggested_for_a_voltage_below_one_cell() -> None:
    assert suggest_count(0.4, cell_voltages("nmc")) is None
    assert not possible_counts(0.4, cell_voltages("nmc"))


def test_possible_counts_end_where_a_cell_would_be_outside_its_voltages() -> None:
    cell = cell_voltages("lfp")
    counts = possible_counts(52.8, cell)
    assert 52.8 / counts.start <= cell.max_v < 52.8 / (counts.start - 1)
    assert 52.8 / (counts.stop - 1) >= cell.min_v > 52.8 / counts.stop
