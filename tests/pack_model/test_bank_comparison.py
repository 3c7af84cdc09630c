"""Deviation of a discharge by one weak cell: its size for weak cells, wrong rows and larger errors."""

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.kernels.accumulators.history import HISTORY_ROW
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import load_cell
from bms_estimator.pack_model.bank_comparison import (
    BIN_SOC,
    MAX_ERROR_RATIO,
    SINCE_EARLIER,
    Comparison,
    Reference,
    ReferenceCurve,
)
from bms_estimator.pack_model.cell_curves import CellCurves
from bms_estimator.pack_model.saved import neutral_fit
from bms_estimator.settings.alarm_limits import WEAK_CELL_STD

SERIES, STD_V = 6, 2e-3
SOC = np.linspace(0.99, 0.11, 45)


@pytest.fixture(scope="module")
def comparison() -> Comparison:
    curves = CellCurves(Estimator(load_cell("ncr18650").pack(SERIES, 1)).cell_file_settings)
    rows = np.zeros(SOC.size, HISTORY_ROW)
    rows["current_a"], rows["temperature_c"], rows["soc"] = 0.5 * curves.one_c_a, 25.0, SOC
    curve = ReferenceCurve(np.zeros(BIN_SOC.size), np.full(BIN_SOC.size, STD_V), 25.0, 0.0)
    return Comparison(curves, Reference(neutral_fit(), curve, SINCE_EARLIER), rows, SOC)


def by_weak_cell(comparison: Comparison, capacity_ratio: float) -> Floats:
    return comparison.weak_cell_deviations(np.zeros(1), np.array([1.0 / capacity_ratio - 1.0]))[:, 0]


def test_a_healthy_discharge_deviates_by_about_one_std(comparison: Comparison) -> None:
    healthy_v = comparison.covariance_factor @ np.random.default_rng(0).standard_normal((SOC.size, 60))
    deviation = np.array([comparison.weakest(each_v).deviation_std for each_v in healthy_v.T])
    assert 0.4 < np.sqrt(np.mean(deviation**2)) < 1.2
    assert (deviation < WEAK_CELL_STD).all()


def test_capacity_of_a_weak_cell_is_found(comparison: Comparison) -> None:
    weakest = comparison.weakest(by_weak_cell(comparison, 0.9))
    assert weakest.deviation_std > WEAK_CELL_STD
    assert weakest.capacity_ratio == pytest.approx(0.9, abs=0.02)


def test_a_change_of_resistance_of_all_cells_is_no_weak_cell(comparison: Comparison) -> None:
    assert comparison.weakest(-0.02 * comparison.measured.drop_v).deviation_std < 1.0


def test_a_single_wrong_row_does_not_raise_the_alarm(comparison: Comparison) -> None:
    for row in (0, SOC.size // 2, SOC.size - 1):
        wrong_v = np.zeros(SOC.size)
        wrong_v[row] = -0.05
        assert comparison.weakest(wrong_v).deviation_std < WEAK_CELL_STD


def test_errors_that_no_weak_cell_explains_reduce_the_deviation_up_to_a_limit(comparison: Comparison) -> None:
    weak_v = by_weak_cell(comparison, 0.8)
    wave_v = np.sin(40.0 * np.pi * SOC)
    deviations = [comparison.weakest(weak_v + size_v * wave_v).deviation_std for size_v in (0.0, 0.01, 0.03)]
    assert deviations[0] > 1.5 * deviations[1]
    assert deviations[2] > 0.8 * deviations[0] / MAX_ERROR_RATIO
