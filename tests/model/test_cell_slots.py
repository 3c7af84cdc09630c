"""Selection of a pack's cells from the slots of its device."""

import numpy as np
import pytest

from bms_estimator.model.cell_slots import CellSlots
from bms_estimator.model.sample import NO_CELLS

NAN = np.nan
LIVE = [3.31, 3.32, 3.33, 3.34]
"""Voltages of the cells of a pack [V]."""


@pytest.mark.parametrize("empty", [0.0, NAN, 0.004, 6.5535], ids=["zero", "nan", "noise", "largest number"])
def test_empty_slots_are_no_cells(empty: float) -> None:
    behind, between = [*LIVE, *[empty] * 20], [*LIVE[:2], *[empty] * 4, *LIVE[2:]]
    assert CellSlots(4).select(np.array([behind])).tolist() == [LIVE]
    assert CellSlots(4).select(np.array([between])).tolist() == [LIVE]


def test_a_failed_cell_keeps_its_slot() -> None:
    slots, whole, failed = CellSlots(4), [*LIVE[:2], 0.0, *LIVE[2:]], [LIVE[0], 0.0, 0.0, *LIVE[2:]]
    assert CellSlots(4).select(np.array([[3.3, 0.0, 3.3, 3.3, 0.0]])).tolist() == [[3.3, 0.0, 3.3, 3.3]]
    assert slots.select(np.array([whole, failed])).tolist() == [LIVE, [LIVE[0], 0.0, *LIVE[2:]]]
    assert slots.select(np.array([failed[:4]])).tolist()[0][:3] == [LIVE[0], 0.0, LIVE[2]]
    assert slots.fault == ""
    assert not slots.select(NO_CELLS).size


def test_more_cells_than_in_series_are_a_fault_and_no_cell_voltages() -> None:
    slots = CellSlots(3)
    assert np.isnan(slots.select(np.array([LIVE]))).all()
    assert slots.fault.startswith("4 cells are measured, but the pack has 3 in series: correct pack.series")
    assert slots.select(np.array([[*LIVE[:3], 0.0]])).tolist() == [LIVE[:3]]
    assert slots.fault == ""


def test_the_selection_does_not_depend_on_the_division_into_blocks() -> None:
    rng = np.random.default_rng(1)
    cells_v = np.where(rng.random((300, 6)) < 0.3, rng.choice([0.0, NAN], (300, 6)), 3.3 + rng.random((300, 6)))
    whole, parts = CellSlots(4), CellSlots(4)
    expected = whole.select(cells_v)
    selected = np.concatenate([parts.select(cells_v[first : first + 7]) for first in range(0, 300, 7)])
    assert selected.tobytes() == expected.tobytes()
