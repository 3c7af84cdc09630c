"""Fits of packs that age: during the history, and before its first row."""

from dataclasses import replace

import numpy as np
import pytest

from bms_estimator.pack_model.aging import CAPACITY, RESISTANCE, Aging, AgingVariance
from bms_estimator.pack_model.aging_course import aging_course
from bms_estimator.pack_model.cell_curves import CellCurves
from bms_estimator.pack_model.fit import LN_Q, LN_R, FitError, PackFit, fit
from bms_estimator.pack_model.intervals import Intervals
from tests.pack_model.histories import Truth, cell_curves, measured_rows, with_voltages

DAY_S = 86400.0
"""Length of a day [s]."""
DAYS = 150
"""Number of days of ``histories.DAY`` in which resistances grow."""
GROWTH = 0.3
"""Growth of ln of the resistances in this time."""
VISITED = slice(16, 33)
"""Points of ``SOC_GRID`` from SOC 0.4 to 0.8."""


def measured_cell() -> CellCurves:
    """Return the curves of a cell whose file was fitted to its own captures."""
    cell = cell_curves()
    cell.r_std, cell.capacity_std = 0.1, 0.02
    return cell


def aged_rows(cell: CellCurves, ln_r: float) -> np.ndarray:
    """Return every twelfth cycle of a history in which the resistances grow linearly by a factor of exp(``ln_r``)."""
    rows = measured_rows(cell, days=DAYS)
    new, old = (with_voltages(cell, rows, Truth(ln_r=(r, r, r))) for r in (0.0, ln_r))
    part = rows["elapsed_s"] / rows["elapsed_s"][-1]
    new["voltage_v"] += np.expm1(part * ln_r) / np.expm1(ln_r) * (old["voltage_v"] - new["voltage_v"])
    cycle = np.cumsum(np.diff(rows["direction"], prepend=0.0) == 1.0) // 2  # two discharges a day
    return new[cycle % 12 == 11]


@pytest.fixture(scope="module")
def aged() -> tuple[CellCurves, np.ndarray, PackFit]:
    """Return a cell file, rows of a pack whose resistances grow by a factor of exp(``GROWTH``), and the fit of the rows."""
    cell = measured_cell()
    rows = aged_rows(cell, GROWTH)
    return cell, rows, fit(cell, rows)


def test_resistances_are_those_of_the_present(aged) -> None:
    _, _, fitted = aged
    np.testing.assert_allclose(fitted.ln_r[VISITED], GROWTH, atol=0.04)


def test_course_contains_the_growth_of_the_resistances_and_a_constant_capacity(aged) -> None:
    cell, rows, fitted = aged
    course = aging_course(cell, rows, fitted)
    ohm = cell.series * cell.resistances(np.array([0.5]), np.ones(1), np.ones(1))[0]
    for resistance, new_ohm in ((course.series, ohm[0]), (course.total, ohm.sum())):
        np.testing.assert_allclose(resistance.value[[0, -1]], new_ohm * np.exp([0.0, GROWTH]), rtol=0.04)
        change, std = resistance.relative_change()
        assert abs(change - np.expm1(GROWTH)) < 2.0 * std < 0.4
    np.testing.assert_allclose(course.capacity.value, cell.capacity_as / 3600.0, rtol=0.02)
    change, std = course.capacity.relative_change()
    assert abs(change) < 2.0 * std < 0.1
    assert course.end_s == rows["elapsed_s"][-1] > course.capacity.elapsed_s[-1]


def test_present_values_of_the_course_are_those_of_the_fit() -> None:
    cell, truth = cell_curves(), Truth(ln_q=-0.1, ln_r=(0.2, 0.2, 0.2))
    rows = with_voltages(cell, measured_rows(cell, days=3), truth)
    fitted = fit(cell, rows)
    course = aging_course(cell, rows, fitted)
    assert course.capacity.value[-1] * 3600.0 / cell.capacity_as == pytest.approx(np.exp(fitted.mean[LN_Q]), rel=0.005)
    std = np.sqrt(np.diag(fitted.covariance))
    assert course.capacity.std[-1] / course.capacity.value[-1] == pytest.approx(std[LN_Q], rel=0.1)
    assert course.series.std[-1] / course.series.value[-1] < 2.0 * std[LN_R][0]


def test_course_without_a_minimum_of_the_last_fit_is_an_error() -> None:
    cell = cell_curves()
    rows = with_voltages(cell, measured_rows(cell, days=1), Truth())
    with pytest.raises(FitError, match="no minimum"):
        aging_course(cell, rows, replace(fit(cell, rows), curves=()))


def test_a_pack_that_aged_before_the_history_may_differ_from_its_cell_file() -> None:
    """Rows of two years have been dropped. The cell file allows for 2 % of the capacity."""
    cell, truth = measured_cell(), Truth(ln_q=-0.25, ln_r=(0.9, 0.9, 0.9))
    rows = with_voltages(cell, measured_rows(cell, days=5), truth)
    rows["elapsed_s"] += 730.0 * DAY_S
    fitted = fit(cell, rows)
    assert abs(fitted.mean[LN_Q] - truth.ln_q) < 0.02
    np.testing.assert_allclose(fitted.ln_r[VISITED], truth.ln_r[0], atol=0.05)


def test_variance_grows_with_use_and_time() -> None:
    cell, aging = cell_curves(), Aging(use_std=0.3, time_std=0.1)
    rows = measured_rows(cell, days=6)
    intervals = Intervals(cell, rows)
    variance = AgingVariance(aging, cell, intervals)
    assert variance.before < 1e-6
    assert (np.diff(variance.at_start) > 0.0).all()
    used_soc, years = rows["throughput_soc"][-1], rows["elapsed_s"][-1] / 365.0 / DAY_S
    expected = 0.3**2 * used_soc / cell.aged_soc + 0.1**2 * years
    assert 0.6 * expected < variance.at_start[-1] < expected
    rows["elapsed_s"] += rows["elapsed_s"][-1] - rows["elapsed_s"][0]
    assert AgingVariance(aging, cell, Intervals(cell, rows)).before > 0.9 * expected


def test_history_without_use_has_no_trend() -> None:
    cell = cell_curves()
    rows = measured_rows(cell, days=1)[:1]
    for aging in (CAPACITY, RESISTANCE):
        np.testing.assert_array_equal(AgingVariance(aging, cell, Intervals(cell, rows)).trend, [0.0])
