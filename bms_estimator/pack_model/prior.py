"""Prior of the slow fit's unknowns: mean and precision (inverse covariance)."""

import math

import numpy as np
from numpy.typing import NDArray

from bms_estimator.kernels.kalman_filter.anchors import FULL
from bms_estimator.kernels.kalman_filter.ekf import INDEPENDENT_R_STD
from bms_estimator.kernels.kalman_filter.hypotheses import HYST_STD
from bms_estimator.kernels.kalman_filter.ocv_correction import CORRELATION_SOC
from bms_estimator.model.arrays import Floats
from bms_estimator.pack_model.cell_curves import SOC_GRID, CellCurves
from bms_estimator.pack_model.intervals import Intervals
from bms_estimator.pack_model.unknowns import (
    CURVE_NODES,
    DIRECTION_NODES,
    DIRECTIONS,
    SCALES,
    SHAPE_NODES,
    Unknowns,
)

SLIP_SOC = 0.02
"""Std of the place of a feature of the OCV along SOC."""
SLIP_CORRELATION_SOC = 0.3
"""Correlation length of that place [SOC]."""
MAX_SLIP_PART = 0.85
"""Maximum std of the slip as a fraction of the OCV's std."""
MAX_SLIP_SLOPE_V = 5.0
"""Maximum slope of the OCV that converts a slip to a voltage [V]."""
ROUNDING_V2 = 1e-10
"""Variance added to each node of the OCV's error, so that rounding leaves its covariance positive definite [V^2]."""
DIRECTION_CORRELATION_SOC = 0.1
"""Correlation length of the error by direction [SOC]."""
SHAPE_STD, SHAPE_CORRELATION_SOC = 0.15, 0.4
"""Relative std of the resistances over SOC, and its correlation length."""
RC_CORRELATION = 0.7
"""Prior correlation of the scales of the fast and slow RC pairs."""
HYSTERESIS_MEAN, HYSTERESIS_STD = 0.5, 0.5
"""Prior of the fraction of the cell file's hysteresis in each of its two parts."""
ENTROPY_STD_V = 1.5e-4
"""Std of the temperature coefficient of the OCV [V/K]."""
ARRHENIUS_STD = 0.004
"""Std of the relative change of the resistances beyond that of the cell file [1/K]."""
MIN_FULL_STD = 0.006
"""Minimum std of the SOC at which this pack's charger ends, common to all charges."""
FULL_REPEAT_STD = 0.01
"""Std of the SOC of one end of charge about the mean of this pack's charges."""
CALENDAR_STD = 0.05
"""Std of the change of the capacity in a year without use."""
MIN_CAPACITY_STD, MIN_AGING_STD = 1e-4, 1e-4
"""Minimum std of ln of the capacity, and of its change between two intervals, so that the precision is finite."""
MIN_OFFSET_STD_C, MIN_DAYS = 1e-6, 1e-4
"""Minimum std of the offset as a C-rate, and minimum time from interval to interval [days], so that the precision is
finite."""
NEW_SEGMENT_SOC, NEW_SEGMENT_STD = 0.5, 1.0
"""Mean and std of the SOC after a gap. Any charge may be hidden in it."""
DAY_S, YEAR_DAYS = 86400.0, 365.0
"""Length of a day [s] and of a year [days]."""


class Prior:
    """Normal prior of all unknowns.

    Args:
        cell: Curves of the cell file.
        intervals: Intervals of the history.
        u: Positions of the unknowns.

    Attributes:
        mean: Shape (unknowns,).
        precision: Inverse of the covariance, shape (unknowns, unknowns).
    """

    def __init__(self, cell: CellCurves, intervals: Intervals, u: Unknowns) -> None:
        self.mean, self.precision = np.zeros(u.size), np.zeros((u.size, u.size))
        self._add_constants(u)
        self._add_functions_of_soc(cell, u)
        self.precision[u.ln_r, u.ln_r] = np.linalg.inv(scale_covariance(cell.r_std))
        self._add_square([u.full.start], [1.0], full_std(intervals.rows))
        self._add_soc(intervals, u)
        self._add_offset(cell, intervals, u)
        self._add_capacity(cell, intervals, u)

    def _add_square(self, at: list[int], factors: list[float], std: float) -> None:
        """Add the squared sum of factors times deviations over the variance."""
        self.precision[np.ix_(at, at)] += np.outer(factors, factors) / std**2

    def _add_constants(self, u: Unknowns) -> None:
        """Add the unknowns that are single numbers."""
        self.mean[u.hysteresis] = HYSTERESIS_MEAN
        diagonal = self.precision.ravel()[:: u.size + 1]
        for part, std in (
            (u.hysteresis, HYSTERESIS_STD),
            (u.start_hysteresis, HYST_STD),
            (u.entropy, ENTROPY_STD_V),
            (u.arrhenius, ARRHENIUS_STD),
        ):
            diagonal[part] = 1.0 / std**2

    def _add_functions_of_soc(self, cell: CellCurves, u: Unknowns) -> None:
        """Add the nodes of OCV, error by direction and resistances over SOC."""
        nodes = np.linspace(0.0, 1.0, CURVE_NODES)
        covariance = curve_covariance(cell, nodes) + ROUNDING_V2 * np.eye(CURVE_NODES)
        self.precision[u.curve, u.curve] = np.linalg.inv(covariance)
        by_direction = node_precision(DIRECTION_NODES, DIRECTION_CORRELATION_SOC)
        self.precision[u.direction, u.direction] = np.kron(np.eye(DIRECTIONS), by_direction)
        self.precision[u.shape, u.shape] = node_precision(SHAPE_NODES, SHAPE_CORRELATION_SOC) / SHAPE_STD**2

    def _add_soc(self, intervals: Intervals, u: Unknowns) -> None:
        """Add the SOC at the start of each segment."""
        for k in np.flatnonzero(intervals.is_new_segment).tolist():
            self.mean[u.soc.start + k] = NEW_SEGMENT_SOC
            self._add_square([u.soc.start + k], [1.0], NEW_SEGMENT_STD)

    def _add_offset(self, cell: CellCurves, intervals: Intervals, u: Unknowns) -> None:
        """Add the current offset, which drifts as a first-order Gauss-Markov process."""
        std = max(cell.offset_std_a / cell.one_c_a, MIN_OFFSET_STD_C)
        self._add_square([u.offset.start], [1.0], std)
        for k, days in enumerate(days_between(intervals), start=1):
            keep = math.exp(-max(days, MIN_DAYS) * DAY_S / cell.offset_s)
            self._add_square([u.offset.start + k, u.offset.start + k - 1], [1.0, -keep], std * math.sqrt(1.0 - keep**2))

    def _add_capacity(self, cell: CellCurves, intervals: Intervals, u: Unknowns) -> None:
        """Add ln of the capacity, which changes by use and by time as a random walk."""
        rows, starts = intervals.rows, intervals.starts
        self._add_square([u.ln_q.start], [1.0], max(cell.capacity_std, MIN_CAPACITY_STD))
        used_soc = rows["throughput_soc"][intervals.ends] - rows["throughput_soc"][starts]
        for k, days in enumerate(days_between(intervals), start=1):
            by_use = 2.0 * cell.capacity_std**2 * max(float(used_soc[k - 1]), 0.0) / cell.aged_soc
            variance = by_use + CALENDAR_STD**2 * days / YEAR_DAYS + MIN_AGING_STD**2
            self._add_square([u.ln_q.start + k, u.ln_q.start + k - 1], [1.0, -1.0], math.sqrt(variance))


def days_between(intervals: Intervals) -> list[float]:
    """Return the time from the start of each interval to that of the next [days]."""
    days: list[float] = (np.diff(intervals.rows["elapsed_s"][intervals.starts]) / DAY_S).tolist()
    return days


def full_std(rows: NDArray[np.void]) -> float:
    """Return the std of the SOC at which the charger ends, common to all charges.

    The charger of the cell file may end at another point, in the same way with each charge.
    """
    is_full = rows["reference_kind"] == FULL
    if not is_full.any():
        return MIN_FULL_STD
    common = float(np.mean(rows["reference_std"][is_full] ** 2)) - FULL_REPEAT_STD**2
    return math.sqrt(max(common, MIN_FULL_STD**2))


def scale_covariance(r_std: float) -> Floats:
    """Return the prior covariance of the scales of the resistances, shape (SCALES, SCALES)."""
    common = max(r_std**2 - INDEPENDENT_R_STD**2, 0.0)
    own = r_std**2 - common
    covariance = np.full((SCALES, SCALES), common) + np.diag(np.full(SCALES, own))
    covariance[1, 2] = covariance[2, 1] = common + RC_CORRELATION * own
    return covariance


def curve_covariance(cell: CellCurves, soc: Floats) -> Floats:
    """Return the prior covariance of the OCV's error at each pair of SOCs, shape (n, n) [V^2].

    One part is an error of voltage, the other a displacement of the curve's features along SOC.
    """
    error_v = np.interp(soc, SOC_GRID, cell.error_v)
    slope_v = np.minimum(cell.slope(soc, SLIP_SOC), MAX_SLIP_SLOPE_V)
    slip_v = np.minimum(SLIP_SOC * slope_v, MAX_SLIP_PART * error_v)
    level_v = np.sqrt(error_v**2 - slip_v**2)
    distance = np.abs(soc[:, None] - soc)
    slip_v2 = np.outer(slip_v, slip_v) * np.exp(-distance / SLIP_CORRELATION_SOC)
    level_v2 = np.outer(level_v, level_v) * np.exp(-distance / CORRELATION_SOC)
    return np.asarray(slip_v2 + level_v2)


def variance_between_nodes(cell: CellCurves, soc: Floats) -> Floats:
    """Return the mean variance of the OCV's error about its interpolation between two nodes [V^2]."""
    correlation = math.exp(-1.0 / (CURVE_NODES - 1) / CORRELATION_SOC)
    return np.asarray(np.interp(soc, SOC_GRID, cell.error_v) ** 2 * (1.0 - correlation) / 3.0)


def node_precision(nodes: int, length_soc: float) -> Floats:
    """Return the inverse correlation matrix of evenly spaced nodes over SOC 0..1."""
    soc = np.linspace(0.0, 1.0, nodes)
    return np.linalg.inv(np.exp(-np.abs(soc[:, None] - soc) / length_soc))
