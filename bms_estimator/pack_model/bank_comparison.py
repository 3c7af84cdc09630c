"""Weakest cell of a bank in series, from the voltage of the bank alone (section 7.2 of the thesis).

A discharge is compared with earlier discharges of the same bank, its reference. If one of N cells has become weaker, the
open-circuit voltage of the mean cell deviates from the reference by

    (E(z - d) - V(z - d) - E(z) + V(z)) / N,    d(z) = shift + shrink (1 - z)

where E is the fitted OCV, V the overpotential under the present load, z the SOC of the other cells and d the SOC by which
the weak cell lies below them. ``shift`` is d when the others are full, and 1 / (1 + shrink) is the capacity of the weak cell
relative to theirs. The position of the weak cell remains unknown, because the sum of the voltages does not depend on it.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bms_estimator.kernels.kalman_filter.records import Noise
from bms_estimator.model.arrays import Floats
from bms_estimator.pack_model.cell_curves import SOC_GRID, CellCurves
from bms_estimator.pack_model.fit import LIKELIHOOD_EXPONENT, PackFit
from bms_estimator.pack_model.open_circuit import OpenCircuit, fitted_ocv, fitted_slope

BINS = 50
"""Number of SOC bins of the reference."""
BIN_SOC = (np.arange(BINS) + 0.5) / BINS
"""SOC in the middle of each bin."""
MIN_REFERENCE_ROWS = 50
"""Minimum number of rows of the reference: one complete discharge, or two of half the capacity."""
MIN_ROWS = 4
"""Minimum number of rows of a discharge for a comparison."""
PRIOR_ROWS = 4.0
"""Weight of the prior variance of a bin, in rows."""
REPEAT_STD_V, REPEAT_STD_SOC = 1e-3, 0.003
"""Prior std of the difference of E_o of the mean cell between two discharges: a voltage error [V] and an SOC error. The stds in
this module are one to four times the values that maximize the likelihood of simulated healthy banks, because a real bank has
further errors."""
INDEPENDENT_FRACTION = 0.2
"""Fraction of the variance of E_o between discharges that is independent from row to row. The rest is correlated over
``CORRELATED_SOC``."""
CORRELATED_SOC = 0.4
"""Correlation length of the difference of E_o between two discharges [SOC]."""
COMMON_DROP_STD_PER_K = 0.002
"""Relative std of the overpotential, per kelvin of temperature difference from the reference [1/K]. All cells and rows share this
error. Its cause is the temperature dependence of a generic cell file, which was measured on another cell."""
LOAD_DROP_STD = 0.02
"""Std of the overpotential's error, as a fraction of its difference from the mean overpotential of the reference. The error is
independent from row to row. Its cause is that the fitted RC pairs are less exact for loads that differ from the usual ones."""
MAX_ERROR_RATIO = 3.0
"""Maximum factor by which the std of all errors is increased. The factor is the RMS of the normalized residuals of the best
hypothesis, because a real bank may have larger errors than assumed. It is limited, because several weak cells also cause
residuals, and must still raise the alarm."""
SHIFTS, SHRINKS = np.linspace(0.0, 0.4, 21), np.linspace(0.0, 0.6, 25)
"""Tested values of ``shift`` and ``shrink``."""
SHIFT_STD, SHRINK_STD = 0.03, Noise.cell_spread
"""Std of the priors of ``shift`` (assumed) and ``shrink``. The prior of ``shrink`` is the cell imbalance that the filter
assumes for the published ``soc_std``."""
MIN_DIFFERENCE_STD = 0.01
"""Minimum std of the difference between the SOCs of the weak cell and of the others, added in quadrature: half the step of
``SHIFTS``."""

SHIFT, SHRINK = (values.ravel() for values in np.meshgrid(SHIFTS, SHRINKS, indexing="ij"))
"""``shift`` and ``shrink`` of each hypothesis."""
LN_PRIOR = -0.5 * ((SHIFT / SHIFT_STD) ** 2 + (SHRINK / SHRINK_STD) ** 2)
"""ln of the prior density of each hypothesis, up to a constant."""


@dataclass(frozen=True)
class CommonChange:
    """Std of the changes that all cells of a healthy bank share since the reference."""

    soc: float
    """Error of the counted SOC."""
    capacity: float
    """Relative change of the capacity."""
    drop: float
    """Relative change of the overpotential."""


SINCE_EARLIER = CommonChange(soc=0.003, capacity=0.003, drop=0.01)
"""Change since the earlier discharges of the history. The values were chosen in the same way as ``REPEAT_STD_V``."""
SINCE_FIRST = CommonChange(soc=0.005, capacity=0.05, drop=0.1)
"""Change since the first discharges of the bank. Two std are 10 % less capacity and 20 % more resistance by aging. Assumed."""


@dataclass(frozen=True)
class ComparedCell:
    """Estimate of the weakest cell from one discharge."""

    soc: float
    """SOC of the other cells at the last row."""
    filter_soc: float
    """SOC of the bank at the last row, as estimated by the filter."""
    deviation_std: float
    """Significance of a weak cell: square root of twice the log-likelihood ratio of a weak cell and no weak cell [std]. The row
    that supports the weak cell most is omitted. The value is 1 or less in most discharges of a healthy bank."""
    mean: Floats
    """Mean of ``shift`` and ``shrink``."""
    covariance: Floats
    """Covariance of ``shift`` and ``shrink``."""

    @property
    def capacity_ratio(self) -> float:
        """Capacity of the weakest cell relative to the others."""
        return float(1.0 / (1.0 + self.mean[1]))

    def others_soc(self, filter_soc: float) -> float:
        """Return the SOC of the other cells when the filter's SOC of the bank is ``filter_soc``."""
        return min(self.soc + filter_soc - self.filter_soc, 1.0)

    def weakest_soc(self, filter_soc: float) -> tuple[float, float]:
        """Return mean and std of the weakest cell's SOC when the filter's SOC of the bank is ``filter_soc``.

        The std is that of the difference from the other cells. It does not contain the std of the filter's SOC. An
        over-discharged cell has an SOC of 0.
        """
        soc = self.others_soc(filter_soc)
        weights = np.array([1.0, 1.0 - soc])
        variance = max(float(weights @ self.covariance @ weights), 0.0)
        return max(soc - float(weights @ self.mean), 0.0), math.hypot(math.sqrt(variance), MIN_DIFFERENCE_STD)


@dataclass(frozen=True)
class ReferenceCurve:
    """Mean and std of the difference of E_o from the fitted OCV in the reference discharges, for each SOC bin."""

    error_v: Floats
    """Mean of ``OpenCircuit.error_v``, shape (BINS,) [V]."""
    std_v: Floats
    """Std of the difference of another discharge of the same bank from ``error_v``, shape (BINS,) [V]."""
    temperature_c: float
    """Mean temperature [degC]."""
    drop_v: float
    """Mean overpotential [V]."""

    @classmethod
    def of(cls, cell: CellCurves, fit: PackFit, rows: NDArray[np.void], soc: Floats) -> "ReferenceCurve | None":
        """Return the curve of the reference rows; None if there are fewer than ``MIN_REFERENCE_ROWS``.

        Args:
            cell: Curves of the cell file.
            fit: Fit of the history.
            rows: Shape (n,), dtype HISTORY_ROW.
            soc: SOC of the rows, shape (n,).
        """
        if rows.size < MIN_REFERENCE_ROWS:
            return None
        measured = OpenCircuit.of(cell, fit, rows, soc)
        bins = np.clip((measured.soc * BINS).astype(np.intp), 0, BINS - 1)
        count = np.bincount(bins, minlength=BINS)
        mean_v = np.bincount(bins, measured.error_v, BINS) / np.maximum(count, 1)
        squares_v2 = np.bincount(bins, (measured.error_v - mean_v[bins]) ** 2, BINS)
        prior_v2 = REPEAT_STD_V**2 + (REPEAT_STD_SOC * fitted_slope(cell, fit, BIN_SOC)) ** 2
        variance_v2 = (squares_v2 + PRIOR_ROWS * prior_v2) / (count + PRIOR_ROWS)
        is_known = count > 1
        # in a bin with fewer than two reference rows, the error of the cell file's OCV is added
        unknown_v2 = np.where(is_known, 0.0, np.interp(BIN_SOC, SOC_GRID, cell.ocv_std_v) ** 2)
        return cls(
            error_v=np.interp(BIN_SOC, BIN_SOC[is_known], mean_v[is_known]) if is_known.any() else np.zeros(BINS),
            std_v=np.sqrt(variance_v2 * (1.0 + 1.0 / np.maximum(count, 1)) + unknown_v2),
            temperature_c=float(measured.temperature_c.mean()),
            drop_v=float(measured.drop_v.mean()),
        )


@dataclass(frozen=True)
class Reference:
    """Reference curve of a bank, with the model for comparisons with it."""

    fit: PackFit
    """Fit with which E_o is computed from the voltages of the discharge."""
    curve: ReferenceCurve
    common: CommonChange
    """Std of the changes since the reference."""


class Comparison:
    """Comparison of one discharge with the reference of its bank.

    The likelihood of each hypothesis allows for changes that all cells share: of SOC, capacity and resistances.

    Args:
        cell: Curves of the cell file.
        reference: Reference of the bank.
        rows: Shape (n,), dtype HISTORY_ROW: rows of the discharge with a voltage.
        soc: SOC of the rows under the assumption that no cell is weak, shape (n,).

    Attributes:
        measured: Open-circuit voltages of the rows.
        deviation_v: Deviation of E_o of the mean cell from the reference, shape (n,) [V].
        covariance_factor: Lower Cholesky factor of the covariance of ``deviation_v`` of a healthy bank, shape (n, n) [V].
    """

    def __init__(self, cell: CellCurves, reference: Reference, rows: NDArray[np.void], soc: Floats) -> None:
        self.measured = OpenCircuit.of(cell, reference.fit, rows, soc)
        self.deviation_v: Floats = self.measured.error_v - np.interp(soc, BIN_SOC, reference.curve.error_v)
        self._cell, self._fit, self._filter_soc = cell, reference.fit, float(rows["soc"][-1])
        covariance = _covariance(cell, reference, self.measured)
        self.covariance_factor: Floats = np.linalg.cholesky(covariance).astype(np.float64)

    def weakest(self, deviation_v: Floats | None = None) -> ComparedCell:
        """Return the estimate of the weakest cell.

        Args:
            deviation_v: Deviations of E_o of the mean cell, shape (n,) [V]; None: those of the discharge.
        """
        whitened = np.linalg.solve(self.covariance_factor, self.deviation_v if deviation_v is None else deviation_v)
        templates = np.linalg.solve(self.covariance_factor, self.weak_cell_deviations(SHIFT, SHRINK))
        ln_by_row = templates * whitened[:, None] - 0.5 * templates**2
        residuals = whitened - templates[:, ln_by_row.sum(axis=0).argmax()]
        ln_by_row /= np.clip(np.mean(residuals**2), 1.0, MAX_ERROR_RATIO**2)
        # the row that supports a hypothesis most is left out, because a single wrong row must not raise the alarm
        ln_likelihood = ln_by_row.sum(axis=0) - np.maximum(ln_by_row.max(axis=0), 0.0)
        ln_weight = LN_PRIOR + LIKELIHOOD_EXPONENT * ln_likelihood
        weight = np.exp(ln_weight - ln_weight.max())
        values = np.stack([SHIFT, SHRINK])
        return ComparedCell(
            soc=float(self.measured.soc[-1]),
            filter_soc=self._filter_soc,
            deviation_std=math.sqrt(max(2.0 * float(ln_likelihood.max()), 0.0)),
            mean=np.average(values, axis=1, weights=weight),
            covariance=np.cov(values, aweights=weight, ddof=0).astype(np.float64),
        )

    def weak_cell_deviations(self, shift: Floats, shrink: Floats) -> Floats:
        """Return the deviations of E_o of the mean cell that m hypothetical weak cells would cause, shape (n, m) [V].

        Args:
            shift: Difference between the SOC of the full cells and that of the weak cell, shape (m,).
            shrink: Capacity of the others relative to that of the weak cell, minus 1, shape (m,).
        """
        soc = self.measured.soc[:, None]
        weak_soc = soc - shift - shrink * (1.0 - soc)
        weak_v = fitted_ocv(self._cell, self._fit, weak_soc) - self.measured.overpotential.at(weak_soc)
        other_v = fitted_ocv(self._cell, self._fit, soc) - self.measured.drop_v[:, None]
        return np.asarray((weak_v - other_v) / self._cell.series)


def _covariance(cell: CellCurves, reference: Reference, measured: OpenCircuit) -> Floats:
    """Return the covariance of the deviations of a healthy bank, shape (n, n) [V^2]."""
    z, curve, change = measured.soc, reference.curve, reference.common
    std_v = np.interp(z, BIN_SOC, curve.std_v)
    slope_v = fitted_slope(cell, reference.fit, z)
    difference_k = measured.temperature_c - curve.temperature_c
    common = np.column_stack(
        [
            change.soc * slope_v,
            change.capacity * slope_v * (1.0 - z),
            np.hypot(change.drop, COMMON_DROP_STD_PER_K * difference_k) * measured.drop_v,
        ]
    )
    correlation = (1.0 - INDEPENDENT_FRACTION) * np.exp(-np.abs(z[:, None] - z) / CORRELATED_SOC)
    correlation[np.diag_indices(z.size)] = 1.0
    load_error_v2 = (LOAD_DROP_STD * (measured.drop_v - curve.drop_v)) ** 2
    return np.asarray(np.outer(std_v, std_v) * correlation + common @ common.T + np.diag(load_error_v2))
