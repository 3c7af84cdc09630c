"""Open-circuit voltage from points of relaxation tests in the form (2.10).

``Points`` of one or more tests are fitted jointly. (5.1)-(5.2) average the parameters of single fits instead, which
is offered for comparison: parameters that lean on each other do not average well.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares, lsq_linear

from bms_estimator.calibration.ocv.points import Points, check_points
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import ChenMoraOcv

NAMES = ("a16", "a17", "a18", "a19", "a20", "a21")
LOWER = np.array([1e-6, 5.0, 1e-6, -np.inf, -np.inf, -np.inf])
"""Least a16..a21. The thesis has all positive; the cubic of a real cell may want another sign of a19..a21, so those are
free: the NCR18650 points fit to 9.6 mV RMS, with all positive to 10.6. Below an exponent of 5 the exponential covers
all SOC and cannot be distinguished from the cubic."""
UPPER = np.array([np.inf, 300.0, np.inf, np.inf, np.inf, np.inf])
"""Above an exponent of 300 the exponential is gone at SOC 0.01. a16 is bounded by the highest point: E_o(0) is not
far below 0 V, even if the last points are steep."""
AT_BOUND_V = 1e-5
"""An amplitude this near to its bound is at it: no converter reads so little [V]."""
EXPONENTS = np.geomspace(5.0, 300.0, 60)
"""Exponents a17 the search starts from."""


@dataclass(frozen=True)
class ChenMoraFit:
    """a16..a21 of (2.10) by least squares.

    Attributes:
        a: Shape (6,), a16..a21.
        std: Shape (6,), standard errors; NaN for a parameter at its bound.
        residual_v: Shape (n,), points less curve [V].
    """

    a: Floats
    std: Floats
    residual_v: Floats

    def __call__(self, soc: Floats) -> Floats:
        """E_o(SOC) [V]."""
        return chen_mora(self.a, soc)

    @property
    def ocv(self) -> ChenMoraOcv:
        """Return the ``[ocv]`` section of a cell file."""
        a16, a17, a18, a19, a20, a21 = (float(a) for a in self.a)
        return ChenMoraOcv(amplitude_v=a16, exponent=a17, constant_v=a18, linear_v=a19, quadratic_v=a20, cubic_v=a21)


def chen_mora(a: Floats, soc: Floats) -> Floats:
    """E_o(SOC) [V] for a = a16..a21, (2.10)."""
    a16, a17, a18, a19, a20, a21 = a
    curve = -a16 * np.exp(-a17 * soc) + a18 + a19 * soc - a20 * soc**2 + a21 * soc**3  # (2.10)
    return np.asarray(curve, dtype=np.float64)


def fit_chen_mora(points: Points) -> ChenMoraFit:
    """Fit (2.10) to points: a16..a21 within their bounds, each point with the same weight.

    For a given exponent a17 the others are bounded linear least squares; the best of a grid of exponents starts
    the fit of all six.

    Raises:
        UserError: Too few points, or points that span too little SOC.
    """
    check_points(points)
    upper = np.r_[points.ocv_v.max(), UPPER[1:]]
    starts = [_with_exponent(points, exponent, upper) for exponent in EXPONENTS]
    _, start = min(starts, key=lambda found: found[0])
    inside = np.clip(start, LOWER + 1e-9, upper * 0.999)
    scale = np.array([0.1, 10.0, 1.0, 1.0, 1.0, 1.0])
    found = least_squares(
        lambda a: chen_mora(a, points.soc) - points.ocv_v, inside, bounds=(LOWER, upper), x_scale=scale, xtol=1e-12
    )
    a = found.x if 2.0 * found.cost < min(starts, key=lambda x: x[0])[0] else start
    residual_v = points.ocv_v - chen_mora(a, points.soc)
    return ChenMoraFit(a=a, std=_standard_errors(a, upper, points.soc, residual_v), residual_v=residual_v)


def _with_exponent(points: Points, exponent: float, upper: Floats) -> tuple[float, Floats]:
    """Squared residual and a16..a21 with a17 given."""
    x = points.soc
    basis = np.column_stack([-np.exp(-exponent * x), np.ones_like(x), x, -(x**2), x**3])
    free = [0, 2, 3, 4, 5]
    found = lsq_linear(basis, points.ocv_v, bounds=(LOWER[free], upper[free]), tol=1e-14)
    a16, a18, a19, a20, a21 = found.x
    return 2.0 * float(found.cost), np.array([a16, exponent, a18, a19, a20, a21])


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
    """a16..a21 as the mean of single fits, (5.1)-(5.2). Shape (6,)."""
    return np.asarray(np.mean([fit.a for fit in fits], axis=0), dtype=np.float64)  # (5.1), (5.2)
