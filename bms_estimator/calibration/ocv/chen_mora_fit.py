"""Fit of Chen and Mora's formula of the open-circuit voltage, (2.10) of the thesis, to points of relaxation tests.

The formula has the coefficients a16 to a21. ``Points`` of one or more tests are fitted jointly. For comparison,
``average`` averages the parameters of single fits as the thesis does in (5.1)-(5.2). The mean of strongly correlated
parameters is a poor fit.
"""

import math
from dataclasses import dataclass
from itertools import product

import numpy as np

from bms_estimator.calibration.ocv.points import Points, check_points
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import ChenMoraOcv

NAMES = ("a16", "a17", "a18", "a19", "a20", "a21")
"""Names of the parameters of (2.10)."""
LOWER = np.array([1e-6, 5.0, 1e-6, -np.inf, -np.inf, -np.inf])
"""Lower bounds of a16..a21. In the thesis all are positive. a19..a21 are unbounded here, because the cubic of a real
cell may have negative coefficients: the NCR18650 points fit to 9.6 mV RMS, and to 10.6 mV with positive coefficients.
Below an exponent of 5 the exponential covers all SOC and cannot be distinguished from the cubic."""
UPPER = np.array([np.inf, 300.0, np.inf, np.inf, np.inf, np.inf])
"""Upper bounds of a16..a21. At an exponent of 300 the exponential has decayed by SOC 0.01. ``fit_chen_mora`` bounds a16
by the highest point, so that E_o(0) is not far below 0 V even if the last points are steep."""
AT_BOUND_V = 1e-5
"""Distance from its bound below which an amplitude counts as at the bound: less than the resolution of converters
[V]."""
EXPONENTS = np.geomspace(5.0, 300.0, 60)
"""Candidate exponents a17. The search continues between the neighbors of the best one."""
GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)
"""Factor by which each step of a golden-section search shortens the interval."""
SEARCH_STEPS = 40
"""Number of these steps. They find the exponent to 1e-9 of its value."""


@dataclass(frozen=True)
class ChenMoraFit:
    """Result of a least-squares fit of (2.10).

    Attributes:
        a: Shape (6,), a16..a21.
        std: Shape (6,), standard errors; NaN for a parameter at its bound.
        residual_v: Shape (n,), points less curve [V].
    """

    a: Floats
    std: Floats
    residual_v: Floats

    def __call__(self, soc: Floats) -> Floats:
        """Return E_o(SOC) [V]."""
        return chen_mora(self.a, soc)

    @property
    def ocv(self) -> ChenMoraOcv:
        """Return the ``[ocv]`` section of a cell file."""
        a16, a17, a18, a19, a20, a21 = (float(a) for a in self.a)
        return ChenMoraOcv(amplitude_v=a16, exponent=a17, constant_v=a18, linear_v=a19, quadratic_v=a20, cubic_v=a21)


def chen_mora(a: Floats, soc: Floats) -> Floats:
    """Return E_o(SOC) [V] for a = a16..a21, (2.10)."""
    a16, a17, a18, a19, a20, a21 = a
    curve = -a16 * np.exp(-a17 * soc) + a18 + a19 * soc - a20 * soc**2 + a21 * soc**3  # (2.10)
    return np.asarray(curve, dtype=np.float64)


def fit_chen_mora(points: Points) -> ChenMoraFit:
    """Fit (2.10) to equally weighted points, with a16..a21 within their bounds.

    For a given exponent a17 the fit is a bounded linear least squares (variable projection). The exponent with the
    smallest residual is searched between the neighbors of the best one of a grid.

    Raises:
        UserError: Too few points, or points that span too little SOC.
    """
    check_points(points)
    upper = np.r_[points.ocv_v.max(), UPPER[1:]]
    best = min(range(EXPONENTS.size), key=lambda i: _fit_with_exponent(points, float(EXPONENTS[i]), upper)[0])
    low, high = math.log(EXPONENTS[max(best - 1, 0)]), math.log(EXPONENTS[min(best + 1, EXPONENTS.size - 1)])
    candidates = [_fit_with_exponent(points, float(EXPONENTS[best]), upper)]
    for _ in range(SEARCH_STEPS):
        left, right = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
        fits = [_fit_with_exponent(points, math.exp(ln_exponent), upper) for ln_exponent in (left, right)]
        low, high = (low, right) if fits[0][0] < fits[1][0] else (left, high)
        candidates += fits
    _, a = min(candidates, key=lambda fit: fit[0])
    residual_v = points.ocv_v - chen_mora(a, points.soc)
    return ChenMoraFit(a=a, std=_standard_errors(a, upper, points.soc, residual_v), residual_v=residual_v)


def _fit_with_exponent(points: Points, exponent: float, upper: Floats) -> tuple[float, Floats]:
    """Fit (2.10) with a given a17; return the squared residual and a16..a21.

    Only a16 and a18 have bounds. The fit tries each of them free and at its bounds, and keeps the best valid solution.
    """
    soc = points.soc
    basis = np.column_stack([-np.exp(-exponent * soc), np.ones_like(soc), soc, -(soc**2), soc**3])
    best = (math.inf, np.zeros(6))
    for a16, a18 in product((math.nan, LOWER[0], upper[0]), (math.nan, LOWER[2])):  # nan: free
        x = np.array([a16, a18, math.nan, math.nan, math.nan])
        free = np.isnan(x)
        x[free] = np.linalg.lstsq(basis[:, free], points.ocv_v - basis[:, ~free] @ x[~free])[0]
        a = np.array([x[0], exponent, *x[1:]])
        residual_v = points.ocv_v - basis @ x
        squared = float(residual_v @ residual_v)
        if squared < best[0] and (a >= LOWER).all() and (a <= upper).all():
            best = squared, a
    return best


def _standard_errors(a: Floats, upper: Floats, soc: Floats, residual_v: Floats) -> Floats:
    """Return standard errors of a16..a21 from the Jacobian of (2.10); NaN for a parameter at its bound."""
    a16, a17 = a[0], a[1]
    decay = np.exp(-a17 * soc)
    jacobian = np.column_stack([-decay, a16 * soc * decay, np.ones_like(soc), soc, -(soc**2), soc**3])
    free = (a > LOWER * 1.001 + AT_BOUND_V) & (a < upper * 0.999)
    std = np.full(6, np.nan)
    freedom = soc.size - int(free.sum())
    if freedom > 0:
        variance = float(residual_v @ residual_v) / freedom
        covariance = np.linalg.pinv(jacobian[:, free].T @ jacobian[:, free]) * variance
        std[free] = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return std


def average(fits: list[ChenMoraFit]) -> Floats:
    """Return a16..a21 as the mean of single fits, (5.1)-(5.2). Shape (6,)."""
    return np.asarray(np.mean([fit.a for fit in fits], axis=0), dtype=np.float64)  # (5.1), (5.2)
