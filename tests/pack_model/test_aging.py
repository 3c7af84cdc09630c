"""Fits of packs that age: during the history, and before its first row."""

import numpy as np

from bms_estimator.pack_model.aging import CAPACITY, RESISTANCE, Aging, AgingVariance
from bms_estimator.pack_model.cell_curves import CellCurves
from bms_estimator.pack_model.fit import LN_Q, fit
from bms_estimator.pack_model.intervals import Intervals
from tests.pack_model.histories import Truth, cell_curves, measured_rows, with_voltages

DAY_S = 86400.0
"""Length of a day [s]."""
DAYS = 150
"""Number of days of ``histories.DAY`` in which resistances grow."""
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


def test_resistances_are_those_of_the_present() -> None:
    ln_r = 0.3
    cell = measured_cell()
    fitted = fit(cell, aged_rows(cell, ln_r))
    np.testing.assert_allclose(fitted.ln_r[VISITED], ln_r, atol=0.04)


def test_a_pack_that_aged_before_the_history_may_differ_from_its_cell_file() -> None:
    """Rows of two years have been dropped. The cell file allows for 2 % of the capacity."""
    cell, truth = measured_cell(), Truth(ln_q=-0.25, ln_r=(0.9, 0.9, 0.9))
    rows = with_voltages(cell, measured_rows(cell, days=5), truth)
    rows["elapsed_s"] += 730.0 * DAY_S
    fitted = fit(cell, rows)
    assert abs(fitted.mean[LN_Q] - truth.ln_q) < 0.02
    np.testing.assert_allclose(fitted.ln_r[VISITED], truth.ln_r[0], atol=0.05)


def test_variance_grows_with_use_and_time() -> None:
    cell, aging = cell_curves(), Aging(by_use=0.3, by_time=0.1)
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
