"""Prior of the slow fit's unknowns: mean and precision (inverse covariance).

Values of constants without a stated reason are assumed. ``make ablation-weeks`` shows the effect of each part of the prior.
"""

import math

import numpy as np
from numpy.typing import NDArray

from bms_estimator.kernels.kalman_filter.anchors import FULL
from bms_estimator.kernels.kalman_filter.ekf import INDEPENDENT_R_STD
from bms_estimator.kernels.kalman_filter.hypotheses import HYST_STD, SHAPE_CORRELATION_SOC, SHAPE_STD
from bms_estimator.kernels.kalman_filter.ocv_correction import CORRELATION_SOC
from bms_estimator.kernels.pack_voltage import CURVE_NODES, DIRECTION_NODES, SHAPE_NODES
from bms_estimator.model.arrays import Floats
from bms_estimator.model.input_faults import InputFault
from bms_estimator.pack_model.aging import CAPACITY, RESISTANCE, AgingVariance
from bms_estimator.pack_model.cell_curves import SOC_GRID, CellCurves
from bms_estimator.pack_model.intervals import Intervals
from bms_estimator.pack_model.unknowns import DIRECTIONS, SCALES, Unknowns

SLIP_SOC = 0.02
"""Std of the slip: distance along SOC between a knee or step of the pack's OCV and that of the file."""
SLIP_CORRELATION_SOC = 0.3
"""Correlation length of the slip [SOC]."""
MAX_SLIP_FRACTION = 0.85
"""Maximum std of the voltage error due to the slip, as a fraction of the OCV's std. The remaining error does not depend on the
slope of the curve."""
MAX_SLIP_SLOPE_V = 5.0
"""Maximum slope of the OCV that converts a slip to a voltage [V per unit SOC], equal to ``filter_settings.MAX_SLOPE_V``. The SOC
is better defined at the steep ends."""
ROUNDING_V2 = 1e-10
"""Variance added to each node of the OCV's error, so that rounding leaves its covariance positive definite [V^2]."""
DIRECTION_CORRELATION_SOC = 0.1
"""Correlation length of the direction-dependent error [SOC]."""
EMPTY_SHAPE_STD = 0.5
"""Std of this relative error at SOC 0. Resistances near empty depend on the cell and on the load: at SOC 0 they are 1.4 to 3.4
times those at SOC 0.5 in the cell files of Leaf, NCR18650, A123 and PF."""
RC_CORRELATION = 0.7
"""Prior correlation of the scales of the fast and slow RC pairs."""
HYSTERESIS_MEAN, HYSTERESIS_STD = 0.5, 0.5
"""Mean and std of the factors on the cell file's hysteresis in its fast and in its slow part."""
ENTROPY_STD_V = 1.5e-4
"""Std of the error of the OCV's temperature coefficient [V/K]."""
ARRHENIUS_STD = 0.015
"""Std of the error of the relative change of the resistances with temperature [1/K]."""
MIN_FULL_STD = 0.006
"""Minimum std of the SOC at which this pack's charger ends, common to all charges."""
FULL_REPEAT_STD = 0.01
"""Std of the SOC at one end of charge about the mean over the ends of charge of this pack."""
MIN_CAPACITY_STD, MIN_AGING_STD = 1e-4, 1e-4
"""Minimum std of ln of the capacity, and of its change between two intervals. A std of 0 has no finite precision."""
DRIFT_FRACTION = 0.05
"""Fraction of the variance of the current sensor's offset that drifts. The rest is constant. Assumed: temperature changes the
offset by a tenth of its std from day to day. If all of the offset drifted, a charge counted over a week would have no
information."""
MIN_OFFSET_STD_C, ROUNDING_FRACTION = 1e-6, 1e-6
"""Minimum std of the offset as a C-rate, and fraction of its variance that is independent in each interval. Both keep the
precision finite."""
NEW_SEGMENT_SOC, NEW_SEGMENT_STD = 0.5, 1.0
"""Mean and std of the SOC at the start of a segment. The gap before it may hide any charge."""
FAULT_STDS = 4.0
"""Distance of an unknown from the mean of its prior above which the input or the cell file counts as wrong [std]."""


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
        self._add_resistances(cell, intervals, u)
        self._add_square([u.full.start], [1.0], full_std(intervals.rows))
        self._add_soc(intervals, u)
        self._add_offset(cell, intervals, u)
        self._add_capacity(cell, intervals, u)

    def faults(self, u: Unknowns, x: Floats) -> InputFault:
        """Return the faults that unknowns beyond ``FAULT_STDS`` indicate. Kinds of unknowns are independent in the prior."""

        def is_far(part: slice) -> bool:
            variance = np.diag(np.linalg.inv(self.precision[part, part]))
            return bool(((x[part] - self.mean[part]) ** 2 > FAULT_STDS**2 * variance).any())

        return InputFault(
            InputFault.FITTED_CURVE * any(map(is_far, (u.curve, u.direction, u.hysteresis)))
            + InputFault.FITTED_RESISTANCE * any(map(is_far, (u.ln_r, u.aging, u.shape)))
            + InputFault.FITTED_TEMPERATURE * any(map(is_far, (u.entropy, u.arrhenius)))
        )

    def _add_square(self, at: list[int], factors: list[float], std: float) -> None:
        """Add a squared residual to the cost: sum of factors times deviations from the mean, divided by ``std``."""
        self.precision[np.ix_(at, at)] += np.outer(factors, factors) / std**2

    def _add_constants(self, u: Unknowns) -> None:
        """Add hysteresis, loads before segments, temperature coefficients and the rate of aging."""
        self.mean[u.hysteresis] = HYSTERESIS_MEAN
        diagonal = self.precision.ravel()[:: u.size + 1]
        for part, std in (
            (u.hysteresis, HYSTERESIS_STD),
            (u.start_hysteresis, HYST_STD),
            (u.start_load, 1.0),
            (u.entropy, ENTROPY_STD_V),
            (u.arrhenius, ARRHENIUS_STD),
            (u.aging, 1.0),
        ):
            diagonal[part] = 1.0 / std**2

    def _add_functions_of_soc(self, cell: CellCurves, u: Unknowns) -> None:
        """Add the nodes of the OCV's error, of the direction-dependent error, and of the resistances' error over SOC."""
        nodes = np.linspace(0.0, 1.0, CURVE_NODES)
        covariance = curve_covariance(cell, nodes) + ROUNDING_V2 * np.eye(CURVE_NODES)
        self.precision[u.curve, u.curve] = np.linalg.inv(covariance)
        direction_precision = node_precision(DIRECTION_NODES, DIRECTION_CORRELATION_SOC)
        self.precision[u.direction, u.direction] = np.kron(np.eye(DIRECTIONS), direction_precision)
        shape_std = np.array([EMPTY_SHAPE_STD, *[SHAPE_STD] * (SHAPE_NODES - 1)])
        shape_precision = node_precision(SHAPE_NODES, SHAPE_CORRELATION_SOC)
        self.precision[u.shape, u.shape] = shape_precision / np.outer(shape_std, shape_std)

    def _add_soc(self, intervals: Intervals, u: Unknowns) -> None:
        """Add the SOC at the start of each segment."""
        for k in np.flatnonzero(intervals.is_new_segment).tolist():
            self.mean[u.soc.start + k] = NEW_SEGMENT_SOC
            self._add_square([u.soc.start + k], [1.0], NEW_SEGMENT_STD)

    def _add_offset(self, cell: CellCurves, intervals: Intervals, u: Unknowns) -> None:
        """Add the current offset: a constant part and a first-order Gauss-Markov process."""
        std = max(cell.offset_std_a / cell.one_c_a, MIN_OFFSET_STD_C)
        start_s = intervals.rows["elapsed_s"][intervals.starts]
        drift = np.exp(-np.abs(start_s[:, None] - start_s) / cell.offset_s)
        correlation = 1.0 - DRIFT_FRACTION + DRIFT_FRACTION * drift + ROUNDING_FRACTION * np.eye(intervals.count)
        self.precision[u.offset, u.offset] = np.linalg.inv(correlation) / std**2

    def _add_capacity(self, cell: CellCurves, intervals: Intervals, u: Unknowns) -> None:
        """Add ln of the capacity, which changes by use and by time as a random walk."""
        aging = AgingVariance(CAPACITY, cell, intervals)
        std = math.sqrt(cell.capacity_std**2 + aging.before)
        self._add_square([u.ln_q.start], [1.0], max(std, MIN_CAPACITY_STD))
        for k, variance in enumerate(np.diff(aging.at_start).tolist(), start=1):
            std = math.sqrt(variance + MIN_AGING_STD**2)
            self._add_square([u.ln_q.start + k, u.ln_q.start + k - 1], [1.0, -1.0], std)

    def _add_resistances(self, cell: CellCurves, intervals: Intervals, u: Unknowns) -> None:
        """Add the factors on the resistances in the last interval, with the variance of all aging since the pack's first row."""
        aging = AgingVariance(RESISTANCE, cell, intervals)
        covariance = scale_covariance(cell.r_std) + aging.before + aging.at_start[-1]
        self.precision[u.ln_r, u.ln_r] = np.linalg.inv(covariance)


def full_std(rows: NDArray[np.void]) -> float:
    """Return the std of the mean SOC at which this pack's charger ends.

    All charges of this charger may end at another SOC than the charge that defined SOC 1 of the cell file.
    """
    is_full = rows["reference_kind"] == FULL
    if not is_full.any():
        return MIN_FULL_STD
    variance = float(np.mean(rows["reference_std"][is_full] ** 2)) - FULL_REPEAT_STD**2
    return math.sqrt(max(variance, MIN_FULL_STD**2))


def scale_covariance(r_std: float) -> Floats:
    """Return the prior covariance of ln of the factors on the resistances, shape (SCALES, SCALES)."""
    common = max(r_std**2 - INDEPENDENT_R_STD**2, 0.0)
    independent = r_std**2 - common
    covariance: Floats = np.full((SCALES, SCALES), common) + np.diag(np.full(SCALES, independent))
    covariance[1, 2] = covariance[2, 1] = common + RC_CORRELATION * independent
    return covariance


def curve_covariance(cell: CellCurves, soc: Floats) -> Floats:
    """Return the prior covariance of the OCV's error at each pair of SOCs, shape (n, n) [V^2].

    It has three parts: an error of voltage, the slip of knees and steps along SOC, and the error of the voltage sensor's gain.
    """
    std_v = np.interp(soc, SOC_GRID, cell.ocv_std_v)
    slope_v = np.minimum(cell.slope(soc, SLIP_SOC), MAX_SLIP_SLOPE_V)
    slip_v = np.minimum(SLIP_SOC * slope_v, MAX_SLIP_FRACTION * std_v)
    level_v = np.sqrt(std_v**2 - slip_v**2)
    distance = np.abs(soc[:, None] - soc)
    slip_v2 = np.outer(slip_v, slip_v) * np.exp(-distance / SLIP_CORRELATION_SOC)
    level_v2 = np.outer(level_v, level_v) * np.exp(-distance / CORRELATION_SOC)
    gain_v = cell.gain_std * cell.ocv(soc)
    return np.asarray(slip_v2 + level_v2 + np.outer(gain_v, gain_v))


def variance_between_nodes(cell: CellCurves, soc: Floats) -> Floats:
    """Return the mean variance of the OCV's error about its interpolation between two nodes [V^2].

    For an exponential correlation it is (1 - correlation of the two nodes) / 3 of the variance, to first order in their
    distance.
    """
    correlation = math.exp(-1.0 / (CURVE_NODES - 1) / CORRELATION_SOC)
    return np.asarray(np.interp(soc, SOC_GRID, cell.ocv_std_v) ** 2 * (1.0 - correlation) / 3.0)


def node_precision(nodes: int, length_soc: float) -> Floats:
    """Return the inverse correlation matrix of evenly spaced nodes over SOC 0..1."""
    soc = np.linspace(0.0, 1.0, nodes)
    return np.linalg.inv(np.exp(-np.abs(soc[:, None] - soc) / length_soc))
