"""Open-circuit voltage from points of relaxation tests: the form (2.10), or a monotone table.

``Points`` of one or more tests are fitted jointly. (5.1)-(5.2) average the parameters of single fits instead, which
is offered for comparison: parameters that lean on each other do not average well.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.optimize import least_squares, lsq_linear

from bms_estimator.calibration.relaxation import LEAST_POINTS, RelaxationTest
from bms_estimator.model.cell import ChenMoraOcv, TableOcv
from bms_estimator.model.errors import UserError

Floats = NDArray[np.float64]

NAMES = ("a16", "a17", "a18", "a19", "a20", "a21")
LOWER = np.array([1e-6, 5.0, 1e-6, -np.inf, -np.inf, -np.inf])
"""Least a16..a21. The thesis has all positive; the cubic of a real cell may want another sign of a19..a21, so those are
free: the NCR18650 points fit to 9.6 mV RMS, with all positive to 10.6. Below an exponent of 5 the exponential reaches
over all SOC, and nothing tells it from the cubic."""
UPPER = np.array([np.inf, 300.0, np.inf, np.inf, np.inf, np.inf])
"""Above an exponent of 300 the exponential is gone at SOC 0.01."""
EXPONENTS = np.geomspace(5.0, 300.0, 60)
"""Exponents a17 the search starts from."""
SAME_SOC = 0.004
"""Points nearer than this in SOC become one node of the table."""
LEAST_SLOPE_V = 1e-4
"""Least slope of a table between nodes, per cell of 4 V and 1 of SOC: monotone means invertible [V]."""


@dataclass(frozen=True)
class Points:
    """Points of the open-circuit voltage.

    Attributes:
        soc: Shape (n,), increasing, 0..1.
        ocv_v: Shape (n,) [V].
        std_v: Shape (n,), standard deviation of ``ocv_v`` [V].
        empty_v: Voltage at SOC 0 as far as it is known [V]; NaN when it is not.
        full_v: Voltage at SOC 1 as far as it is known [V]; NaN when it is not.
    """

    soc: Floats
    ocv_v: Floats
    std_v: Floats
    empty_v: float = float("nan")
    full_v: float = float("nan")


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
        """As the ``[ocv]`` section of a cell file."""
        a16, a17, a18, a19, a20, a21 = (float(a) for a in self.a)
        return ChenMoraOcv(amplitude_v=a16, exponent=a17, constant_v=a18, linear_v=a19, quadratic_v=a20, cubic_v=a21)


@dataclass(frozen=True)
class TableFit:
    """A monotone table through the points.

    Attributes:
        soc: Nodes from 0 to 1.
        ocv_v: Voltages at the nodes, increasing [V].
        residual_v: Shape (n,), points less curve [V].
    """

    soc: Floats
    ocv_v: Floats
    residual_v: Floats

    def __call__(self, soc: Floats) -> Floats:
        """E_o(SOC) [V], PCHIP."""
        return np.asarray(PchipInterpolator(self.soc, self.ocv_v)(soc), dtype=np.float64)

    @property
    def ocv(self) -> TableOcv:
        """As the ``[ocv]`` section of a cell file."""
        return TableOcv(form="table", soc=tuple(self.soc.tolist()), ocv_v=tuple(self.ocv_v.tolist()))


def chen_mora(a: Floats, soc: Floats) -> Floats:
    """E_o(SOC) [V] for a = a16..a21, (2.10)."""
    a16, a17, a18, a19, a20, a21 = a
    curve = -a16 * np.exp(-a17 * soc) + a18 + a19 * soc - a20 * soc**2 + a21 * soc**3  # (2.10)
    return np.asarray(curve, dtype=np.float64)


def rms_v(residual_v: Floats) -> float:
    """Root mean square [V]."""
    return float(np.sqrt(np.mean(residual_v**2)))


def max_v(residual_v: Floats) -> float:
    """Largest magnitude [V]."""
    return float(np.abs(residual_v).max())


def pooled(tests: list[RelaxationTest]) -> Points:
    """The points of several tests as one set, in the order of SOC."""
    soc = np.concatenate([test.soc for test in tests])
    order = np.argsort(soc, kind="stable")
    return Points(
        soc=soc[order],
        ocv_v=np.concatenate([test.ocv_v for test in tests])[order],
        std_v=np.concatenate([test.std_v for test in tests])[order],
        empty_v=_mean([test.empty_v for test in tests]),
        full_v=_mean([test.full_v for test in tests]),
    )


def fit_chen_mora(points: Points) -> ChenMoraFit:
    """Fit (2.10) to points: a16..a21 within their bounds, each point with the same weight.

    For a given exponent a17 the others are bounded linear least squares; the best of a grid of exponents starts
    the fit of all six.

    Raises:
        UserError: Too few points, or points that span too little SOC.
    """
    _check(points)
    starts = [_with_exponent(points, exponent) for exponent in EXPONENTS]
    _, start = min(starts, key=lambda found: found[0])
    inside = np.clip(start, LOWER + 1e-9, UPPER * 0.999)
    scale = np.array([0.1, 10.0, 1.0, 1.0, 1.0, 1.0])
    found = least_squares(
        lambda a: chen_mora(a, points.soc) - points.ocv_v, inside, bounds=(LOWER, UPPER), x_scale=scale, xtol=1e-12
    )
    a = found.x if 2.0 * found.cost < min(starts, key=lambda x: x[0])[0] else start
    residual_v = points.ocv_v - chen_mora(a, points.soc)
    return ChenMoraFit(a=a, std=_standard_errors(a, points.soc, residual_v), residual_v=residual_v)


def _with_exponent(points: Points, exponent: float) -> tuple[float, Floats]:
    """Squared residual and a16..a21 with a17 given."""
    x = points.soc
    basis = np.column_stack([-np.exp(-exponent * x), np.ones_like(x), x, -(x**2), x**3])
    free = [0, 2, 3, 4, 5]
    found = lsq_linear(basis, points.ocv_v, bounds=(LOWER[free], UPPER[free]), tol=1e-14)
    a16, a18, a19, a20, a21 = found.x
    return 2.0 * float(found.cost), np.array([a16, exponent, a18, a19, a20, a21])


def _standard_errors(a: Floats, soc: Floats, residual_v: Floats) -> Floats:
    """Standard errors of a16..a21 from the Jacobian of (2.10); a parameter at its bound is held and has none."""
    a16, a17 = a[0], a[1]
    decay = np.exp(-a17 * soc)
    jacobian = np.column_stack([-decay, a16 * soc * decay, np.ones_like(soc), soc, -(soc**2), soc**3])
    free = (a > LOWER * 1.001 + 1e-7) & (a < UPPER * 0.999)
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


def fit_table(points: Points) -> TableFit:
    """A monotone curve through the points: near ones merged, falling ones levelled, ends reached out to 0 and 1.

    Raises:
        UserError: Too few points, or points that span too little SOC.
    """
    _check(points)
    soc, ocv_v, weight = _merged(points)
    soc, ocv_v, weight = _with_ends(soc, ocv_v, weight, points)
    rising = _increasing(ocv_v, weight, soc)
    curve = PchipInterpolator(soc, rising)
    return TableFit(soc=soc, ocv_v=rising, residual_v=points.ocv_v - curve(points.soc))


def _merged(points: Points) -> tuple[Floats, Floats, Floats]:
    """Points that share their SOC as one, weighted by their certainty."""
    weight: Floats = 1.0 / np.maximum(points.std_v, 1e-3) ** 2
    group = np.cumsum(np.r_[0, np.diff(points.soc) > SAME_SOC])
    total = np.bincount(group, weight)
    return (
        np.bincount(group, weight * points.soc) / total,
        np.bincount(group, weight * points.ocv_v) / total,
        np.asarray(total, dtype=np.float64),
    )


def _with_ends(soc: Floats, ocv_v: Floats, weight: Floats, points: Points) -> tuple[Floats, Floats, Floats]:
    """Nodes at SOC 0 and 1: what is known of them, else the line through the two nearest nodes."""
    if soc[0] > SAME_SOC:
        low = ocv_v[0] - soc[0] * max(ocv_v[1] - ocv_v[0], 0.0) / (soc[1] - soc[0])
        known = points.empty_v if np.isfinite(points.empty_v) else low
        soc, ocv_v, weight = np.r_[0.0, soc], np.r_[min(known, ocv_v[0]), ocv_v], np.r_[weight.min(), weight]
    if soc[-1] < 1.0 - SAME_SOC:
        high = ocv_v[-1] + (1.0 - soc[-1]) * max(ocv_v[-1] - ocv_v[-2], 0.0) / (soc[-1] - soc[-2])
        known = points.full_v if np.isfinite(points.full_v) else high
        soc, ocv_v, weight = np.r_[soc, 1.0], np.r_[ocv_v, max(known, ocv_v[-1])], np.r_[weight, weight.min()]
    soc[0], soc[-1] = 0.0, 1.0
    return soc, ocv_v, weight


def _increasing(ocv_v: Floats, weight: Floats, soc: Floats) -> Floats:
    """Nearest increasing values (pool adjacent violators), then a least slope."""
    slope = LEAST_SLOPE_V * float(np.median(ocv_v)) / 4.0
    values: list[float] = []
    weights: list[float] = []
    counts: list[int] = []
    for value, w in zip(ocv_v - slope * soc, weight, strict=True):
        values.append(float(value))
        weights.append(float(w))
        counts.append(1)
        while len(values) > 1 and values[-2] > values[-1]:
            total = weights[-2] + weights[-1]
            values[-2:] = [(values[-2] * weights[-2] + values[-1] * weights[-1]) / total]
            weights[-2:] = [total]
            counts[-2:] = [counts[-2] + counts[-1]]
    return np.repeat(values, counts) + slope * soc


def _check(points: Points) -> None:
    """Enough points over enough SOC."""
    if points.soc.size < LEAST_POINTS:
        raise UserError(
            f"{points.soc.size} points of the open-circuit voltage; (2.10) has {LEAST_POINTS} parameters and needs at "
            f"least {LEAST_POINTS} points"
        )
    span = float(points.soc[-1] - points.soc[0])
    if span < 0.3:
        raise UserError(
            f"points span SOC {points.soc[0]:.2f} to {points.soc[-1]:.2f} only: discharge over at least 0.3 of the "
            "capacity, best until empty"
        )


def _mean(values: list[float]) -> float:
    known = [value for value in values if np.isfinite(value)]
    return float(np.mean(known)) if known else float("nan")
