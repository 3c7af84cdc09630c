"""Lower bound of the std of the SOC, which remains after infinite time, and changes of use or sensors that lower it.

A pack passes a window of SOC repeatedly. Every error that differs from pass to pass averages out. What remains is the
error of the cell file's OCV curve, and a direction-dependent error (charge, discharge, rest) that recurs at each pass. The
unknowns are the SOC, the capacity, the hysteresis and the curve, with the priors of the slow fit. The model is linear in
small deviations:

    voltage error = slope (dSOC + (SOC - middle) d ln Q) + hysteresis + curve + direction-dependent error

This std is a lower bound: no estimator with only the information of the cell file has a smaller error on average over the
possible cells and over the window. At single SOCs, as near full, the std may be smaller than this mean. Resistances are left
out, because rests separate them: with their prior and currents of 0.4 C the std changes by less than 0.01 %.
"""

from collections.abc import Iterator
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bms_estimator.estimator.filter_settings import CURVE_ERROR_SOC, CURVE_ERROR_V, MAX_SLOPE_V
from bms_estimator.kernels.accumulators.history import ROW_SOC
from bms_estimator.kernels.kalman_filter.anchors import FULL
from bms_estimator.model.arrays import Floats
from bms_estimator.model.payloads.health import SocBound
from bms_estimator.pack_model.cell_curves import DIRECTION_STD_RANGE_V, SOC_GRID, CellCurves
from bms_estimator.pack_model.fit import PackFit, rows_of_this_pack
from bms_estimator.pack_model.prior import (
    DIRECTION_CORRELATION_SOC,
    ENTROPY_STD_V,
    HYSTERESIS_STD,
    MIN_FULL_STD,
    NEW_SEGMENT_STD,
    curve_covariance,
)
from bms_estimator.pack_model.solve import single_threaded

MIN_WINDOW = 0.05
"""Minimum width of a window [SOC]."""
DISCHARGE_C = 0.4
"""Assumed C-rate of the discharges if charges are not measured. The offset of the current sensor is then an error of the
capacity."""
UNMEASURED_K = 10.0
"""Std of the deviation of an unmeasured temperature from 25 C [K], as for ``noise.UNSENSED_R_STD``."""
LOW_SOC = 0.1
"""Proposed lower end of discharge [SOC]."""
MEASURED_FRACTION = 0.8
"""Maximum std of a measured curve, as a fraction of the present std, for which its measurement is proposed."""
EQUIPMENT = "a measured OCV curve", "a temperature sensor"
"""Changes that need equipment or a test. The other ones are only another use of the pack."""
SIMILAR = 1.25
"""Maximum ratio to the lowest std at which another use of the pack is proposed before ``EQUIPMENT``. The assumptions about
curve and use are hardly more accurate."""
SOC, LN_Q, HYSTERESIS, CURVE = 0, 1, 2, 3
"""Positions of the unknowns; the curve's errors are the last ones."""


@dataclass(frozen=True)
class Window:
    """SOCs that a pack passes repeatedly, and the quantities that are measured."""

    low: float
    high: float = 0.95
    full: bool = False
    """True: ends of charge are measured repeatedly. The window then ends at SOC 1."""
    charge_seen: bool = True
    """True: charges are measured, too, so that their balance with the discharges shows the offset of the current sensor."""
    has_temperature: bool = True
    capacity_std: float | None = None
    """Std of ln(true / declared capacity); None: that of the cell file."""

    @property
    def soc(self) -> Floats:
        """SOCs of the history's rows, evenly spaced."""
        high = 1.0 if self.full else self.high
        return np.linspace(self.low, high, max(round((high - self.low) / ROW_SOC), 1) + 1)


def window_of_history(rows: NDArray[np.void], fitted: PackFit | None, *, has_temperature: bool) -> Window:
    """Return the window of a pack's history. Without rows it is empty.

    Args:
        rows: Shape (n,), dtype HISTORY_ROW.
        fitted: Fit of the rows; None: their SOC is that of the filter.
        has_temperature: True: the temperature is measured.
    """
    rows = rows_of_this_pack(rows, fitted)
    if not rows.size:
        return Window(0.0, 0.0, has_temperature=has_temperature)
    soc = np.clip(rows["soc"] if fitted is None else fitted.row_soc, 0.0, 1.0)
    return Window(
        float(soc.min()),
        float(soc.max()),
        full=bool((rows["reference_kind"] == FULL).any()),
        charge_seen=bool((rows["current_a"] < 0.0).any()),
        has_temperature=has_temperature,
    )


class Accuracy:
    """Information of infinitely many passes of a window.

    Args:
        cell: Curves and prior of the cell.
        window: SOCs that the pack passes.
    """

    def __init__(self, cell: CellCurves, window: Window) -> None:
        self.cell, self.window, self.soc = cell, window, window.soc
        self.middle = 0.5 * (self.soc[0] + self.soc[-1])

    def prior(self) -> Floats:
        """Return the prior covariance of the unknowns."""
        capacity_std = self.cell.capacity_std if self.window.capacity_std is None else self.window.capacity_std
        offset_c = self.cell.offset_std_a / self.cell.one_c_a
        relative_offset = 0.0 if self.window.charge_seen else offset_c / DISCHARGE_C
        covariance = np.zeros((CURVE + self.soc.size,) * 2)
        covariance[SOC, SOC] = NEW_SEGMENT_STD**2
        covariance[LN_Q, LN_Q] = capacity_std**2 + relative_offset**2
        covariance[HYSTERESIS, HYSTERESIS] = 2.0 * HYSTERESIS_STD**2  # fast and slow part are both saturated
        # the second term keeps the sum positive definite despite rounding
        curve_v2 = curve_covariance(self.cell, self.soc) + 1e-10 * np.eye(self.soc.size)
        if not self.window.has_temperature:
            temperature_std_v = UNMEASURED_K * np.hypot(
                np.interp(self.soc, SOC_GRID, self.cell.per_kelvin_v), ENTROPY_STD_V
            )
            curve_v2 += np.outer(temperature_std_v, temperature_std_v)
        covariance[CURVE:, CURVE:] = curve_v2
        return covariance

    def information(self) -> Floats:
        """Return the information on the unknowns: of discharge, rest and charge, and of the ends of charge."""
        distance = np.abs(self.soc[:, None] - self.soc)
        precision = np.linalg.inv(np.exp(-distance / DIRECTION_CORRELATION_SOC)) / self.cell.direction_std_v**2
        # sign of the hysteresis in discharges, in the rests after them, and in charges
        signs = (-1.0, -1.0, 1.0) if self.window.charge_seen else (-1.0, -1.0)
        slope_v = self.cell.slope(self.soc)
        hysteresis_v = np.interp(self.soc, SOC_GRID, self.cell.hysteresis_v)
        total = np.zeros((CURVE + self.soc.size,) * 2)
        for sign in signs:
            h = np.column_stack(
                [slope_v, slope_v * (self.soc - self.middle), sign * hysteresis_v, np.eye(self.soc.size)]
            )
            total += h.T @ precision @ h
        if self.window.full:
            at_full = self.soc_derivatives(np.ones(1))[0]
            total += np.outer(at_full, at_full) / MIN_FULL_STD**2
        return total

    def soc_derivatives(self, soc: Floats) -> Floats:
        """Return the derivatives of the SOC with respect to the unknowns, for each estimated ``soc``, shape (n, unknowns)."""
        rows = np.zeros((soc.size, CURVE + self.soc.size))
        rows[:, SOC], rows[:, LN_Q] = 1.0, soc - self.middle
        return rows

    @cached_property
    def spectrum(self) -> tuple[Floats, Floats]:
        """Eigenvalues of the information in units of the prior, ascending, and their directions, as columns."""
        root = np.linalg.cholesky(self.prior())
        values, vectors = np.linalg.eigh(root.T @ self.information() @ root)
        return np.maximum(values, 0.0), root @ vectors

    def std(self, soc: Floats) -> Floats:
        """Return the std of the SOC for each estimated SOC in ``soc``."""
        values, vectors = self.spectrum
        return np.sqrt((self.soc_derivatives(soc) @ vectors) ** 2 @ (1.0 / (1.0 + values)))

    @property
    def capacity_std(self) -> float:
        """Std of ln(true / declared capacity)."""
        values, vectors = self.spectrum
        return float(np.sqrt(vectors[LN_Q] ** 2 @ (1.0 / (1.0 + values))))

    @property
    def mean_std(self) -> float:
        """Mean of the std over the window."""
        return float(self.std(self.soc).mean())


@single_threaded()
def with_soc_bound(fitted: PackFit, cell: CellCurves, rows: NDArray[np.void], has_temperature: bool) -> PackFit:
    """Return a fit of rows with the bound of their use; unchanged if the use is narrow or has no finite bound.

    A bound that cannot be computed must not make the fit fail.
    """
    window = window_of_history(rows, fitted, has_temperature=has_temperature)
    if window.high - window.low >= MIN_WINDOW:
        with suppress(np.linalg.LinAlgError, ValueError):  # also of pydantic, for a value that is not finite
            change, std = next(iter(improvements(cell, window).items()), (None, None))
            bound_std = Accuracy(cell, window).mean_std
            return replace(fitted, soc_bound=SocBound(std=bound_std, change=change, changed_std=std))
    return fitted


def improvements(cell: CellCurves, window: Window) -> dict[str, float]:
    """Return the lower bound of the std in the present window after each possible change, the best change first.

    The best change has the lowest std, unless another use of the pack, which costs nothing, comes near (``SIMILAR``).
    Changes that are already in force are omitted.
    """
    stds = {
        name: float(Accuracy(changed_cell, changed).std(window.soc).mean())
        for name, changed_cell, changed in _changes(cell, window)
    }
    max_std = SIMILAR * min(stds.values(), default=0.0)
    return dict(sorted(stds.items(), key=lambda item: (item[0] in EQUIPMENT or item[1] > max_std, item[1])))


def _changes(cell: CellCurves, window: Window) -> Iterator[tuple[str, CellCurves, Window]]:
    """Yield each possible change with its cell and window."""
    if not window.full:
        yield "a full charge each week", cell, replace(window, full=True)
    if window.low > LOW_SOC:
        yield f"discharges to {LOW_SOC:.0%}", cell, replace(window, low=LOW_SOC)
    measured = measured_curve(cell)
    if measured.ocv_std_v.mean() < MEASURED_FRACTION * cell.ocv_std_v.mean():
        yield "a measured OCV curve", measured, window
    if not window.has_temperature:
        yield "a temperature sensor", cell, replace(window, has_temperature=True)


def measured_curve(cell: CellCurves) -> CellCurves:
    """Return a cell whose curve was measured with the pack's own sensor, so that it contains the sensor's gain."""
    measured = copy(cell)
    slope_v = np.minimum(cell.slope(SOC_GRID), MAX_SLOPE_V)
    measured.ocv_std_v = np.minimum(cell.ocv_std_v, np.hypot(CURVE_ERROR_V, CURVE_ERROR_SOC * slope_v))
    measured.gain_std, measured.direction_std_v = 0.0, min(cell.direction_std_v, DIRECTION_STD_RANGE_V[0])
    return measured
