"""Errors that many rows share: gain of the voltage sensor, error of a pass, and offset of the current sensor."""

from dataclasses import replace

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.model.cell import load_cell
from bms_estimator.pack_model.cell_curves import CellCurves
from bms_estimator.pack_model.fit import LN_Q, SOC
from bms_estimator.pack_model.handover import adopt_curves
from bms_estimator.pack_model.intervals import MAX_INTERVALS, Intervals
from bms_estimator.pack_model.solve import minimize
from bms_estimator.settings.observer import Sampling
from tests.pack_model.histories import (
    Truth,
    cell_curves,
    equations_of,
    measured_rows,
    random_unknowns,
    unknowns_of,
    with_voltages,
)
from tests.pack_model.quick_fit import quick_fit

GAIN_STD = 0.005
"""Std of the voltage gain of a BMS."""
TRUTH = Truth(soc=0.95)


def history(cell: CellCurves) -> np.ndarray:
    return with_voltages(cell, measured_rows(cell, days=4), TRUTH)


def minimum(cell: CellCurves, rows: np.ndarray) -> tuple[float, float]:
    """Return SOC and std at the start of the last interval, at the minimum next to the true values."""
    equations = equations_of(cell, rows)
    found = minimize(equations, unknowns_of(equations, TRUTH))
    assert found is not None
    last = equations.unknowns.soc.stop - 1
    select = np.zeros((1, found.x.size))
    select[0, last] = 1.0
    return float(found.x[last]), float(np.sqrt(found.covariance_of(select)[0, 0]))


def test_an_uncertain_voltage_gain_hardly_widens_the_soc_of_a_flat_curve() -> None:
    """A gain error moves the whole flat curve by nearly one voltage. The bends of the curve still determine the SOC."""
    exact, uncertain = cell_curves("lfp"), cell_curves("lfp", Sampling(voltage_gain_std=GAIN_STD))
    rows = history(exact)
    assert minimum(uncertain, rows)[1] < 1.15 * minimum(exact, rows)[1]


def test_a_wrong_voltage_gain_moves_the_soc_by_less_than_its_std() -> None:
    cell = cell_curves("lfp", Sampling(voltage_gain_std=GAIN_STD))
    rows = history(cell)
    right_soc, _ = minimum(cell, rows)
    rows["voltage_v"] *= 1.0 + GAIN_STD
    wrong_soc, std = minimum(cell, rows)
    assert abs(wrong_soc - right_soc) < std


def test_more_rows_of_the_same_pass_are_no_more_information() -> None:
    """A small current that changes between rest and load divides a pass into many rows."""
    cell = cell_curves()
    rows = history(cell)
    once, often = (equations_of(cell, np.repeat(rows, count)) for count in (1, 4))
    x = 0.5 * (random_unknowns(once) + unknowns_of(once, TRUTH))  # most residuals are within Huber's limit
    assert once.residuals(x).cost > 100.0
    np.testing.assert_allclose(often.residuals(x).cost, once.residuals(x).cost, rtol=0.02)  # Huber's limit differs


def test_most_of_the_offset_is_constant() -> None:
    """The offset has the same std on each day, and changes by a tenth of this std from day to day."""
    cell = cell_curves()
    equations = equations_of(cell, history(cell))
    part = equations.unknowns.offset
    covariance = np.linalg.inv(equations.prior.precision[part, part])
    std_c = cell.offset_std_a / cell.one_c_a
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), std_c, rtol=0.01)
    change = covariance[0, 0] + covariance[1, 1] - 2.0 * covariance[0, 1]
    np.testing.assert_allclose(np.sqrt(change), 0.1 * std_c, rtol=0.2)


def test_the_number_of_intervals_is_bounded() -> None:
    cell = cell_curves()
    rows = measured_rows(cell, days=30)
    assert rows.size > 3 * MAX_INTERVALS
    rows["charge_variance_as2"] = (cell.capacity_as * np.arange(rows.size)) ** 2
    assert Intervals(cell, rows).count <= MAX_INTERVALS
    rows["charge_variance_as2"] = 0.0
    rows["elapsed_s"] *= 100.0
    assert Intervals(cell, rows).count <= MAX_INTERVALS


def test_an_interval_never_crosses_a_segment() -> None:
    cell = cell_curves()
    rows = measured_rows(cell, days=30)
    rows["segment"] = np.arange(rows.size) // 2
    intervals = Intervals(cell, rows)
    assert intervals.count == intervals.segments


def test_the_minimum_std_after_a_fit_is_that_of_the_best_known_soc() -> None:
    """A fit has an SOC std of 3 %. A third of this variance is correlated with the capacity and vanishes at another SOC."""
    estimator = Estimator(load_cell("nmc", 3.0))
    fitted = quick_fit(cell_curves(), measured_rows(cell_curves(), days=1))
    covariance = fitted.covariance.copy()
    covariance[SOC, SOC], covariance[LN_Q, LN_Q] = 9e-4, 25e-4
    covariance[SOC, LN_Q] = covariance[LN_Q, SOC] = np.sqrt(3e-4 * 25e-4)
    settings = estimator.settings_record[0]["filter"]
    adopt_curves(settings, estimator.cell_file_settings, replace(fitted, covariance=covariance))
    assert float(settings["min_soc_std"]) == pytest.approx(np.sqrt(6e-4))
