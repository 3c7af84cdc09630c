"""Points of the open-circuit voltage from one or more sources.

(2.10) of the thesis is Chen and Mora's formula of the open-circuit voltage.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from bms_estimator.calibration.ocv.relaxation_test import MIN_POINTS, RelaxationTest
from bms_estimator.kernels.cell_model.rc_ladder import REFERENCE_C
from bms_estimator.model.arrays import Floats
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
