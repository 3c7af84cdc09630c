"""Step 3 of the thesis: R_s by (4.2) from several currents, and a13..a15 fitted to R_s.

Numbers in parentheses are equations of the thesis. Errata are listed in docs/theory/thesis.md.

The thesis prints (4.2) with the opposite sign. Solving (2.4) for R_s gives i^-1 (E_o - x2 - x3 - y), which is positive:
E_o is the open-circuit voltage, y the terminal voltage, i the current. x2 and x3, the voltages of both RC pairs, are
simulated with constant a1..a12. The observer's x2 and x3 cannot be used: they would contain i R_s, because the
observer's output (4.1) follows y.

(4.2) as printed divides by the current. An error of the open-circuit voltage of 10 mV therefore becomes 65 mohm at C/20
and 2 mohm at 1.5C. The thesis averages over the currents with equal weights, so that the value at C/20 has the weight
of the value at 1.5C (erratum 19). Here the voltage i R_s is fitted by least squares, so that each value of (4.2) has
its squared current as weight.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bms_estimator.calibration.thesis.prediction import Prediction, open_circuit
from bms_estimator.kernels.observer.series_resistance import BINS, MIN_CURRENT_C
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel
from bms_estimator.model.cell_sections import Resistance
from bms_estimator.model.errors import UserError

LOWEST_SOC = 0.1
"""SOC below which (4.2) is not fitted, because real elements deviate from (2.5)-(2.9) there."""
EXPONENTS = np.geomspace(2.0, 200.0, 200)
"""Candidate exponents a14. Over SOC 0..1 e^(-2 SOC) is nearly a straight line; e^(-200 SOC) decays within SOC 0.02."""
MIN_DETERMINANT = 1e-300
"""Lower limit of the determinant of the normal equations, against division by zero."""
MIN_BINS = 5
"""Minimum number of bins for a fit of three parameters."""


@dataclass(frozen=True)
class SeriesResistance:
    """R_s over SOC, one value for each of ``BINS`` with data. All arrays have shape (n,).

    Attributes:
        soc: Mean SOC of the bin's samples, 0..1.
        r_s_ohm: R_s (4.2) of the bin, by least squares on the voltage [ohm].
        weight: Mean of the squared current in the bin [A^2]; after ``mean_of`` the sum of these means over the
            captures.
    """

    soc: Floats
    r_s_ohm: Floats
    weight: Floats


@dataclass(frozen=True)
class SeriesResistanceFit:
    """Fitted coefficients of R_s(SOC) = a13 e^(-a14 SOC) + a15, (2.9).

    Attributes:
        a: a13 [ohm], a14, a15 [ohm].
        std: Standard errors; NaN for a parameter at its bound.
        rms_ohm: RMS of the residual with the weights of the fit [ohm].
    """

    a: Floats
    std: Floats
    rms_ohm: float

    def __call__(self, soc: Floats) -> Floats:
        """Return R_s(SOC) [ohm], (2.9)."""
        return np.asarray(self.a[0] * np.exp(-self.a[1] * soc) + self.a[2], dtype=np.float64)

    @property
    def element(self) -> Resistance:
        """Return the ``[r_s]`` section of a cell file with values above 0."""
        a13, a14, a15 = (max(float(a), 1e-9) for a in self.a)
        return Resistance(amplitude_ohm=a13, exponent=a14, offset_ohm=a15)


def series_resistance(cell: CellModel, run: Prediction) -> SeriesResistance:
    """Return R_s by (4.2) over all samples with current.

    Args:
        cell: Cell with the open-circuit voltage.
        run: Prediction whose ``overpotential_v`` is x2 + x3 with constant a1..a12.

    Raises:
        UserError: No current flows.
    """
    flowing = np.abs(run.current_a) > MIN_CURRENT_C * cell.cell.capacity_ah
    if not flowing.any():
        raise UserError(
            f"R_s by (4.2) needs a current: none above {MIN_CURRENT_C * cell.cell.capacity_ah:.3f} A, the largest is "
            f"{np.abs(run.current_a).max():.3f} A"
        )
    resistive_v = (open_circuit(cell, run.soc) - run.overpotential_v - run.voltage_v)[flowing]
    soc, current_a = run.soc[flowing], run.current_a[flowing]
    bins = _bins(soc)
    samples_of_bin = np.bincount(bins)
    used = np.flatnonzero(samples_of_bin)
    current2_of_bin = np.bincount(bins, current_a**2)[used]
    return SeriesResistance(
        soc=np.bincount(bins, soc)[used] / samples_of_bin[used],
        r_s_ohm=np.bincount(bins, current_a * resistive_v)[used] / current2_of_bin,  # (4.2), with the sign of (2.4)
        weight=current2_of_bin / samples_of_bin[used],
    )


def mean_of(curves: Sequence[SeriesResistance]) -> SeriesResistance:
    """Return the weighted mean over captures at several currents in each bin with data, as in Fig. 22 and 31."""
    soc, r_s, weight = (np.concatenate([getattr(c, name) for c in curves]) for name in ("soc", "r_s_ohm", "weight"))
    bins = _bins(soc)
    total: Floats = np.bincount(bins, weight).astype(np.float64)
    used = np.flatnonzero(total)
    return SeriesResistance(
        soc=np.bincount(bins, weight * soc)[used] / total[used],
        r_s_ohm=np.bincount(bins, weight * r_s)[used] / total[used],
        weight=total[used],
    )


def _bins(soc: Floats) -> NDArray[np.int64]:
    return np.clip((soc * BINS).astype(np.int64), 0, BINS - 1)


def series_resistance_from_sums(record: np.void) -> SeriesResistance:
    """Return R_s over SOC, at the middle of each bin, from the sums that an estimator has accumulated.

    Args:
        record: Record of dtype ESTIMATOR_STATE.
    """
    sums = record["series_resistance"]
    used = np.flatnonzero(sums["square_a2"] > 0.0)
    squares = sums["square_a2"][used]
    return SeriesResistance((used + 0.5) / BINS, sums["product_va"][used] / squares, squares / sums["samples"][used])


def fit_series_resistance(curve: SeriesResistance, lowest_soc: float = 0.0) -> SeriesResistanceFit:
    """Fit (2.9) by non-negative weighted linear least squares for each of ``EXPONENTS``; return the best fit.

    Args:
        curve: R_s over SOC.
        lowest_soc: SOC below which bins are omitted; 0 uses all bins.

    Raises:
        UserError: Too few SOC bins with data.
    """
    used = curve.soc >= lowest_soc
    soc, r_s = curve.soc[used], curve.r_s_ohm[used]
    if soc.size < MIN_BINS:
        raise UserError(f"R_s is known in {soc.size} steps of SOC, at least {MIN_BINS} are needed for a13..a15")
    weight = curve.weight[used] / curve.weight[used].mean()
    a13, exponent, a15 = _best_fit(soc, r_s, weight)
    a, root_weight = np.array([a13, exponent, a15]), np.sqrt(weight)
    residual_norm = float(np.linalg.norm(root_weight * (r_s - a13 * np.exp(-exponent * soc) - a15)))
    decay = np.exp(-exponent * soc)
    jacobian = root_weight[:, None] * np.column_stack([decay, -a13 * soc * decay, np.ones_like(soc)])
    free = np.array([a13 > 0.0, a13 > 0.0 and EXPONENTS[0] < exponent < EXPONENTS[-1], a15 > 0.0])
    std = np.full(3, np.nan)
    variance = residual_norm**2 / max(soc.size - int(free.sum()), 1)
    std[free] = np.sqrt(np.diag(np.linalg.pinv(jacobian[:, free].T @ jacobian[:, free])) * variance)
    return SeriesResistanceFit(a=a, std=std, rms_ohm=residual_norm / float(np.sqrt(soc.size)))


def _best_fit(soc: Floats, r_s: Floats, weight: Floats) -> tuple[float, float, float]:
    """Return a13 >= 0, a14 and a15 >= 0 with the smallest weighted sum of squares, by normal equations."""
    decay = np.exp(-EXPONENTS[:, None] * soc)
    sum_decay2, sum_decay, sum_decay_r = decay**2 @ weight, decay @ weight, decay @ (weight * r_s)
    sum_weight, sum_r = weight.sum(), (weight * r_s).sum()
    determinant = np.maximum(sum_decay2 * sum_weight - sum_decay**2, MIN_DETERMINANT)
    # the minimum lies inside a13, a15 > 0, or at a13 = 0 (flat), or at a15 = 0 (falling to 0)
    inside = (
        (sum_decay_r * sum_weight - sum_decay * sum_r) / determinant,
        (sum_decay2 * sum_r - sum_decay * sum_decay_r) / determinant,
    )
    flat = np.zeros_like(sum_decay2), np.full_like(sum_decay2, max(sum_r / sum_weight, 0.0))
    falling = np.maximum(sum_decay_r / sum_decay2, 0.0), np.zeros_like(sum_decay2)
    a13, a15 = (np.stack(parts) for parts in zip(inside, flat, falling, strict=True))
    cost = (
        a13**2 * sum_decay2
        + 2.0 * a13 * a15 * sum_decay
        + a15**2 * sum_weight
        - 2.0 * (a13 * sum_decay_r + a15 * sum_r)
    )
    cost[(a13 < 0.0) | (a15 < 0.0)] = np.inf
    case, j = np.unravel_index(np.argmin(cost), cost.shape)
    return float(a13[case, j]), float(EXPONENTS[j]), float(a15[case, j])
