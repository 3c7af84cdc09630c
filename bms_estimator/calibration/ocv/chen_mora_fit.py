"""Fit of Chen and Mora's formula of the open-circuit voltage, (2.10) of the thesis, to points of one or more sources.

The formula has the coefficients a16 to a21. ``Points`` of one or more tests are fitted jointly. For comparison,
``average`` averages the parameters of single fits as the thesis does in (5.1)-(5.2). The mean of strongly correlated
parameters is a poor fit.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from bms_estimator.calibration.ocv.relaxation_test import MIN_POINTS, RelaxationTest
from bms_estimator.kernels.cell_model.rc_ladder import REFERENCE_C
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell_sections import ChenMoraOcv
from bms_estimator.model.errors import UserError

RELAXED_V = 0.002
"""Systematic error of rests of a warm cell [V]. Relaxation continues for hours beyond the extrapolation of a rest of a
quarter of an hour."""
COLD_V = 0.012
"""Additional error of rests of up to an hour at 0 C [V]. The error at -10 C is 20 mV."""
DOUBLING_K = 25.0
"""Temperature decrease that doubles the relaxation time [K]."""
COLD_SOURCE_FRACTION = 0.3
"""Fraction of the cold error that is independent between sources. The rest is common to all."""
LONG_REST_S = 3600.0
"""Duration of a rest beyond which the cold error decreases in inverse proportion [s]."""
AFTER_CHARGE_V = 0.005
"""Std of the OCV of a rest after a charge, because the size of the hysteresis is unknown, per cell in series [V]."""
MIN_SPAN = 0.3
"""Minimum SOC range of the points."""


@dataclass(frozen=True)
class Points:
    """Points of the open-circuit voltage.

    Attributes:
        soc: Shape (n,), increasing, 0..1.
        ocv_v: Shape (n,) [V].
        std_v: Shape (n,), standard deviation of ``ocv_v``, independent between points [V].
        systematic_std_v: Shape (n,), standard deviation of the systematic error of the point's source [V].
        cold_v: Shape (n,), standard deviation of the error of incomplete relaxation in the cold, which is common to all
            sources [V].
        temperature_c: Shape (n,), temperature [C]; NaN if unknown.
        direction: Shape (n,), hysteresis state h: -1 after a discharge, 1 after a charge, 0 for their mean.
        source: Shape (n,), index of the point's source, from 0.
        empty_v: Voltage at SOC 0 [V]; NaN if unknown.
        full_v: Voltage at SOC 1 [V]; NaN if unknown.
    """

    soc: Floats
    ocv_v: Floats
    std_v: Floats
    systematic_std_v: Floats = field(default_factory=lambda: np.zeros(0))
    cold_v: Floats = field(default_factory=lambda: np.zeros(0))
    temperature_c: Floats = field(default_factory=lambda: np.zeros(0))
    direction: Floats = field(default_factory=lambda: np.zeros(0))
    source: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    empty_v: float = float("nan")
    full_v: float = float("nan")

    def __post_init__(self) -> None:
        """Fill in the defaults: no systematic error, unknown temperature, no hysteresis, one source."""
        if self.systematic_std_v.size == 0:
            object.__setattr__(self, "systematic_std_v", np.zeros(self.soc.size))
        if self.cold_v.size == 0:
            object.__setattr__(self, "cold_v", np.zeros(self.soc.size))
        if self.temperature_c.size == 0:
            object.__setattr__(self, "temperature_c", np.full(self.soc.size, np.nan))
        if self.direction.size == 0:
            object.__setattr__(self, "direction", np.zeros(self.soc.size))
        if self.source.size == 0:
            object.__setattr__(self, "source", np.zeros(self.soc.size, dtype=np.int64))


def points_of(test: RelaxationTest, series_count: int = 1) -> Points:
    """Return the rests of one test as points.

    Args:
        test: Result of ``relaxation_test``.
        series_count: Cells in series, for values per cell.
    """
    rests = test.rests
    temperature_c = np.array([rest.temperature_c for rest in rests])
    duration_s = np.array([rest.duration_s for rest in rests])
    after_charge = np.array([rest.after_charge for rest in rests])
    cold_v = COLD_V * relaxation_excess(temperature_c) * np.minimum(1.0, LONG_REST_S / np.maximum(duration_s, 1.0))
    order = np.argsort(test.soc, kind="stable")
    return Points(
        soc=test.soc[order],
        ocv_v=test.ocv_v[order],
        std_v=np.hypot(test.std_v, AFTER_CHARGE_V * series_count * after_charge)[order],
        systematic_std_v=(series_count * (RELAXED_V + COLD_SOURCE_FRACTION * cold_v))[order],
        cold_v=(series_count * cold_v)[order],
        temperature_c=temperature_c[order],
        direction=-1.0 * ~after_charge[order],  # a charge between two discharges is too short to reverse the hysteresis
        empty_v=test.empty_v,
        full_v=test.full_v,
    )


def relaxation_excess(temperature_c: Floats) -> Floats:
    """Return the relaxation time relative to that at 25 C, less 1; 0 for an unknown temperature or above 25 C."""
    colder = np.maximum(REFERENCE_C - np.nan_to_num(temperature_c, nan=REFERENCE_C), 0.0)
    return np.asarray(2.0 ** (colder / DOUBLING_K) - 1.0, dtype=np.float64)


def join_points(sources: Sequence[Points]) -> Points:
    """Return the points of several sources in the order of SOC, with the index of each point's source."""
    soc = np.concatenate([source.soc for source in sources])
    order = np.argsort(soc, kind="stable")

    def column(name: str) -> Floats:
        return np.asarray(np.concatenate([getattr(source, name) for source in sources])[order])

    return Points(
        soc=soc[order],
        ocv_v=column("ocv_v"),
        std_v=column("std_v"),
        systematic_std_v=column("systematic_std_v"),
        cold_v=column("cold_v"),
        temperature_c=column("temperature_c"),
        direction=column("direction"),
        source=np.repeat(np.arange(len(sources)), [source.soc.size for source in sources])[order],
        empty_v=_mean([source.empty_v for source in sources]),
        full_v=_mean([source.full_v for source in sources]),
    )


def pool_tests(tests: Sequence[RelaxationTest]) -> Points:
    """Return the points of several tests in the order of SOC."""
    return join_points([points_of(test) for test in tests])


def with_ends(points: Points, empty_std_v: float, full_std_v: float) -> Points:
    """Append ``empty_v`` and ``full_v`` as points if they are finite and lie outside the other points."""
    ends = [(0.0, points.empty_v, empty_std_v), (1.0, points.full_v, full_std_v)]
    missing_ends = [end for end in ends if np.isfinite(end[1]) and not points.soc[0] <= end[0] <= points.soc[-1]]
    for soc, ocv_v, std_v in missing_ends:
        index = 0 if soc == 0.0 else points.soc.size
        nearest = min(index, points.soc.size - 1)
        points = replace(
            points,
            soc=np.insert(points.soc, index, soc),
            ocv_v=np.insert(points.ocv_v, index, ocv_v),
            std_v=np.insert(points.std_v, index, std_v),
            systematic_std_v=np.insert(points.systematic_std_v, index, points.systematic_std_v[nearest]),
            cold_v=np.insert(points.cold_v, index, points.cold_v[nearest]),
            temperature_c=np.insert(points.temperature_c, index, points.temperature_c[nearest]),
            direction=np.insert(points.direction, index, points.direction[nearest]),
            source=np.insert(points.source, index, points.source[nearest]),
        )
    return points


def check_points(points: Points) -> None:
    """Check the number of points and their SOC range.

    Raises:
        UserError: Too few points, or too small a range.
    """
    if points.soc.size < MIN_POINTS:
        raise UserError(
            f"{points.soc.size} points of the open-circuit voltage; (2.10) has {MIN_POINTS} parameters and needs at "
            f"least {MIN_POINTS} points"
        )
    span = float(points.soc[-1] - points.soc[0])
    if span < MIN_SPAN:
        raise UserError(
            f"points span SOC {points.soc[0]:.2f} to {points.soc[-1]:.2f} only: discharge over at least {MIN_SPAN} of "
            "the capacity, best until empty"
        )


def rms_v(residual_v: Floats) -> float:
    """Return the root mean square [V]."""
    return float(np.sqrt(np.mean(residual_v**2)))


def max_v(residual_v: Floats) -> float:
    """Return the largest magnitude [V]."""
    return float(np.abs(residual_v).max())


def _mean(values: list[float]) -> float:
    finite = [value for value in values if np.isfinite(value)]
    return float(np.mean(finite)) if finite else float("nan")


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
