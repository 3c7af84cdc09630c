"""Selection of a pack's cells from the slots of its device."""

import numpy as np
import pytest

from bms_estimator.model.arrays import NO_CELLS
from bms_estimator.model.cell_slots import CellSlots
from bms_estimator.protocols.base.reading_protocol import cell_block

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


def test_after_a_restart_with_a_broken_wire_no_live_cell_is_left_out() -> None:
    """Slot 3 of 8 is empty, and the wire of the cell in slot 1 is broken."""
    slots = np.array([[0.0, 3.3, 0.0, 3.31, 3.32, 3.33, 4.5, 0.0]])
    assert CellSlots(6).select(slots).tolist() == [[0.0, 3.3, 3.31, 3.32, 3.33, 4.5]]


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


@pytest.mark.parametrize("length", [1, 30])
@pytest.mark.parametrize(
    ("rows", "reason"),
    [
        (
            [[3.3] * 14] * 30,
            "14 cells are measured, but the pack has 16 in series: correct pack.series, or measure the others",
        ),
        ([[*[3.3] * 14, 0.0, NAN]] * 30, "14 cells are measured"),
        ([[3.3] * 15] * 30, ""),
        ([[3.3] * 6] * 9, ""),
        ([[3.3] * 6] * 20 + [[3.3] * 16], ""),
        ([[3.3] * 18] * 30, "18 cells are measured, but the pack has 16 in series: correct pack.series. Until then"),
        ([[3.3] * 18] * 15 + [[3.3] * 14] * 15, "14 cells are measured"),
        ([[3.3] * 18] * 15 + [[3.3] * 16] * 15, ""),
        ([[]] * 30, ""),
    ],
)
def test_a_wrong_number_of_cells_is_the_reason_for_no_estimates_live_and_in_a_replay(
    rows: list[list[float]], reason: str, length: int
) -> None:
    slots = CellSlots(16)
    for first in range(0, len(rows), length):
        slots.select(cell_block(rows[first : first + length]))
    assert slots.reason.startswith(reason)
    assert bool(slots.reason) == bool(reason)


def test_a_floating_slot_does_not_replace_a_failed_cell() -> None:
    slots, swapped = CellSlots(4), np.array([[LIVE[0], 0.02, *LIVE[2:], 3.2, 0.0]])
    slots.select(np.array([[*LIVE, 0.0, 0.0]]))
    assert slots.select(swapped).tolist() == [[LIVE[0], 0.02, *LIVE[2:]]]
    assert slots.cell_indices == [0, 1, 2, 3]
    assert CellSlots(4, slots.cell_indices).select(swapped).tolist() == [[LIVE[0], 0.02, *LIVE[2:]]]
    assert CellSlots(3, slots.cell_indices).select(np.array([[0.0, *LIVE[:3]]])).tolist() == [LIVE[:3]]
