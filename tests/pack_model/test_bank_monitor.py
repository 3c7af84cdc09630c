"""Monitor of a bank: division into discharges, decisions of later discharges, and times of weak cells."""

from dataclasses import replace

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.kernels.accumulators.history import HISTORY_ROW, ROW_SOC
from bms_estimator.model.cell import load_cell
from bms_estimator.pack_model.bank_comparison import ComparedCell
from bms_estimator.pack_model.bank_monitor import BankMonitor, discharge_start, reference_rows
from bms_estimator.pack_model.cell_curves import CellCurves
from bms_estimator.pack_model.fit import SOC, PackFit
from bms_estimator.pack_model.history import History, ReferenceDischarges, WeakCellTime
from bms_estimator.pack_model.open_circuit import fitted_ocv
from bms_estimator.pack_model.saved import history_arrays, history_from_arrays, neutral_fit
from bms_estimator.settings.alarm_limits import WEAK_CELL_STD


def rows_of(charge_as: list[float], segment: list[int] | None = None) -> np.ndarray:
    rows = np.zeros(len(charge_as), HISTORY_ROW)
    rows["charge_as"], rows["elapsed_s"], rows["duration_s"] = charge_as, 60.0 * np.arange(rows.size), 60.0
    rows["direction"], rows["reference_soc"] = 1.0, np.nan
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


SERIES, ROWS = 6, 48
CURVES = CellCurves(Estimator(load_cell("ncr18650").pack(SERIES, 1)).cell_file_settings)
FIT = replace(neutral_fit(), mean=np.eye(neutral_fit().mean.size)[SOC])


def discharge(number: int, capacity_ratio: float) -> np.ndarray:
    """Return rows of a discharge from full to SOC 0.04 in which one cell has a lower capacity."""
    soc = 1.0 - ROW_SOC * (np.arange(ROWS) + 0.5)
    rows = rows_of(((1.0 - soc) * CURVES.capacity_as).tolist())
    weak_soc = 1.0 - (1.0 - soc) / capacity_ratio
    rows["voltage_v"] = (SERIES - 1) * fitted_ocv(CURVES, FIT, soc) + fitted_ocv(CURVES, FIT, weak_soc)
    rows["elapsed_s"] += 1e5 * number
    rows["soc"], rows["temperature_c"] = soc, 25.0
    return rows


def discharges(numbers: range, capacity_ratio: float) -> np.ndarray:
    return np.concatenate([discharge(number, capacity_ratio) for number in numbers])


def monitored(history: History, fit: PackFit = FIT) -> BankMonitor:
    """Return a monitor that has compared the last row of a history."""
    monitor = BankMonitor(CURVES)
    monitor.add(history, 1, fit)
    return monitor


def test_a_cell_that_is_weak_in_all_rows_of_the_history_deviates_from_the_first_discharges() -> None:
    rows, healthy = discharges(range(10, 14), 0.9), ReferenceDischarges(discharges(range(5), 1.0), FIT)
    deviation = [monitored(History(rows, first_discharges=first)).weakest.deviation_std for first in (None, healthy)]
    assert deviation[0] < 1.0
    assert deviation[1] > WEAK_CELL_STD


def test_first_discharges_do_not_change() -> None:
    history = History(discharges(range(6), 1.0))
    monitor = monitored(history)
    first = history.first_discharges
    assert first is not None
    assert first.rows["elapsed_s"].max() < 1e5 * 5  # without the present discharge
    history.append(discharge(6, 1.0), CURVES.capacity_as)
    monitor.add(history, 1, FIT)
    assert history.first_discharges is first


def test_first_discharges_of_an_exchanged_pack_are_dropped_also_after_a_restart() -> None:
    history = History(discharges(range(6), 1.0))
    monitored(history)
    assert history.first_discharges is not None
    other = discharge(7, 1.0)
    other["segment"] = 1.0
    history.append(other, CURVES.capacity_as)
    monitored(history, replace(FIT, first_segment=1.0, is_exchanged=True))
    assert history.first_discharges is None


def test_times_of_weak_cells_survive_a_restart() -> None:
    times = [WeakCellTime(60.0, 120.0, 0.5), WeakCellTime(240.0, np.inf, 0.4)]
    restored, _ = history_from_arrays(history_arrays(History(rows_of([0.0]), times), None))
    assert restored.weak_cell_times == times


def test_first_discharges_survive_a_restart() -> None:
    rows = rows_of([0.0, 1.0])
    fit = replace(neutral_fit(), hysteresis=0.5)
    restored, _ = history_from_arrays(
        history_arrays(History(rows, first_discharges=ReferenceDischarges(rows[:1], fit)), None)
    )
    assert restored.first_discharges is not None
    assert restored.first_discharges.rows.tobytes() == rows[:1].tobytes()
    assert restored.first_discharges.fit.hysteresis == 0.5


def test_damaged_times_of_weak_cells_are_rejected() -> None:
    arrays = history_arrays(History(rows_of([0.0])), None) | {"weak_cell_times": np.full((1, 3), np.nan)}
    with pytest.raises(ValueError, match="times of weak cells are damaged"):
        history_from_arrays(arrays)


def test_soc_of_an_over_discharged_cell_is_zero() -> None:
    weakest = ComparedCell(0.1, 0.12, 8.0, np.array([0.0, 0.25]), np.zeros((2, 2)))
    assert weakest.capacity_ratio == pytest.approx(0.8)
    assert weakest.weakest_soc(0.12)[0] == 0.0
    assert weakest.weakest_soc(0.62)[0] == pytest.approx(0.6 - 0.25 * 0.4)
