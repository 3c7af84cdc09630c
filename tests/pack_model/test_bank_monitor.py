"""Monitor of a bank: division into discharges, decisions of later discharges, and times of weak cells."""

from dataclasses import replace

import numpy as np
import pytest

from bms_estimator.kernels.accumulators.history import HISTORY_ROW
from bms_estimator.pack_model.bank_monitor import discharge_start, reference_rows
from bms_estimator.pack_model.history import History, ReferenceDischarges, WeakCellTime
from bms_estimator.pack_model.saved import history_arrays, history_of, neutral_fit
from bms_estimator.pack_model.weakest_cell import WeakestCell


def rows_of(charge_as: list[float], segment: list[int] | None = None) -> np.ndarray:
    rows = np.zeros(len(charge_as), HISTORY_ROW)
    rows["charge_as"], rows["elapsed_s"], rows["duration_s"] = charge_as, 60.0 * np.arange(rows.size), 60.0
    rows["direction"] = 1.0
    if segment is not None:
        rows["segment"] = segment
    return rows


@pytest.mark.parametrize(
    ("charge_as", "segment", "start"),
    [
        ([0.0, 10.0, 20.0, 30.0], None, 0),
        ([0.0, 10.0, 7.0, 20.0], None, 0),  # regeneration
        ([0.0, 50.0, 10.0, 20.0], None, 2),  # a charge
        ([0.0, 50.0, 10.0, 10.0, 20.0], None, 2),  # a charge and a rest
        ([0.0, 10.0, 5.0, 15.0], [0, 0, 1, 1], 2),  # a gap
    ],
)
def test_discharge_begins_after_a_charge_or_a_gap(
    charge_as: list[float], segment: list[int] | None, start: int
) -> None:
    assert discharge_start(rows_of(charge_as, segment), charged_as=5.0) == start


def test_discharges_with_a_weak_cell_are_no_reference() -> None:
    rows = rows_of([0.0, 1.0, 2.0, 3.0, 4.0])
    kept = reference_rows(rows, [WeakCellTime(60.0, 120.0, 0.5), WeakCellTime(240.0, np.inf, 0.4)])
    assert kept["elapsed_s"].tolist() == [0.0, 120.0, 180.0]


def test_times_of_weak_cells_survive_a_restart() -> None:
    times = [WeakCellTime(60.0, 120.0, 0.5), WeakCellTime(240.0, np.inf, 0.4)]
    restored, _ = history_of(history_arrays(History(rows_of([0.0]), times), None))
    assert restored.weak_cell_times == times


def test_first_discharges_survive_a_restart() -> None:
    rows = rows_of([0.0, 1.0])
    fit = replace(neutral_fit(), hysteresis=0.5)
    restored, _ = history_of(history_arrays(History(rows, first=ReferenceDischarges(rows[:1], fit)), None))
    assert restored.first is not None
    assert restored.first.rows.tobytes() == rows[:1].tobytes()
    assert restored.first.fit.hysteresis == 0.5


def test_damaged_times_of_weak_cells_are_rejected() -> None:
    arrays = history_arrays(History(rows_of([0.0])), None) | {"weak_cell_times": np.full((1, 3), np.nan)}
    with pytest.raises(ValueError, match="times of weak cells are damaged"):
        history_of(arrays)


def test_soc_of_an_over_discharged_cell_is_zero() -> None:
    weakest = WeakestCell(0.1, 0.12, 8.0, np.array([0.0, 0.25]), np.zeros((2, 2)))
    assert weakest.empty_soc == pytest.approx(0.2)
    assert weakest.capacity_ratio == pytest.approx(0.8)
    assert weakest.weakest_soc(0.12)[0] == 0.0
    assert weakest.weakest_soc(0.62)[0] == pytest.approx(0.6 - 0.25 * 0.4)
