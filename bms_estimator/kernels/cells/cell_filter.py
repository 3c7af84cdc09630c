"""Kalman filter of one cell's deviations, with scalar measurements, and detection of changes that it does not expect.

Changes are detected by generalized likelihood ratios of the innovations: A. Willsky and H. Jones, "A generalized likelihood
ratio approach to the detection and estimation of jumps in linear systems", IEEE Transactions on Automatic Control 21 (1976),
pages 108-112. The hypotheses are RISE and FALL of the self-discharge, and DRAIN by a balancer. ``response`` is the error that
the filter's state would have, had a change of size 1 begun at the last restart of the hypothesis. Without a change, the
innovations are white, and ``score`` over the root of ``information`` has a standard normal distribution, so that the threshold
needs no training.

``c`` is a record of CELL, ``b`` of BANK_STATE, ``p`` of EKF_SETTINGS.
"""

import math

from bms_estimator.kernels.cells.records import (
    BIAS,
    CAPACITY,
    DRAIN,
    FALL,
    HYPOTHESES,
    LEAK,
    RESISTANCE,
    RISE,
    SOC,
    STATES,
)
from bms_estimator.model.arrays import Floats, Record
from bms_estimator.numba_cache import njit

SOC_STD = 0.1
"""P(0): std of a cell's SOC about the mean."""
CAPACITY_STD = 0.08
"""P(0): relative std of a cell's capacity."""
RESISTANCE_STD = 0.1
"""P(0): relative std of a cell's resistance, including the effect of its temperature."""
LEAK_STD = 3e-5
"""P(0): std of the self-discharge of an intact cell [1/h]: 2 % a month."""
BIAS_V = 0.003
"""P(0): std of a cell's voltage at equal SOC and current, due to offsets of the readings and different OCV curves [V]."""
BIAS_SOC = 0.1
"""Q: charge throughput over which BIAS changes [SOC]. At rest BIAS is constant, so that a long rest does not average it away."""
CHARGE_STD = 3e-4
"""Q: std of a cell's SOC after a throughput of 1, due to differences of the charge efficiency."""
RESISTANCE_DRIFT = 0.05
"""Q: relative change of a cell's resistance in one hour, because the cells warm up differently."""
LEAK_DRIFT = 5e-7
"""Q: change of the self-discharge in one hour [1/h]."""
SHORT_DRIFT_H, SHORT_DRIFT = 10.0, 0.1
"""Q: change of a short's self-discharge in one hour: ``SHORT_DRIFT_H`` [h] times its square, and at most the fraction
``SHORT_DRIFT`` of it."""
GAP_STD = 0.003
"""Q: std of a cell's SOC after a gap, in which a balancer may have been active."""
BALANCING_C = 0.002
"""Q: current of a balancer, as a C-rate."""
BALANCING_SPREAD_V = 0.005
"""Minimum difference from the voltage of the lowest cell at which a balancer may drain a cell [V]."""
READING_V = 0.001
"""R: std of the mean of a cell's readings in one window [V]."""
DROP_ERROR = 0.05
"""R: relative std of the overpotential, because current and voltages are not measured at one time."""
MAX_RESISTANCE_STD = 0.3
"""Maximum of the relative std of a cell's resistance after a time without a load."""
CURVE_STDS = 2.0
"""Half width of the SOC range in which the OCV curve is compared with its tangent, in std of the SOC."""
CURVE_WINDOWS = 30.0
"""Number of successive windows with nearly the same error of the OCV curve. Averaging over these windows does not reduce the
error."""
FLAT_SOC = (0.1, 0.9)
"""SOC range of the mean slope of the OCV curve, without its steep ends."""
STEEP_RATIO = 4.0
"""Minimum slope of the OCV curve near full, relative to the mean slope, of a steep curve. The generic LFP cell has 144, the
generic NMC cell 1.8."""
KNEE_SOC = 0.02
"""Std of the SOC at which the OCV curve of a single cell falls near empty."""
HOUR_S = 3600.0
"""Duration of an hour [s]."""
MIN_CHANGE_C = 2e-5
"""Minimum change of the self-discharge current, as a C-rate [1/h]: 1.4 % a month, less than ``LEAK_STD`` of an intact cell. A
hypothesis with a smaller estimate starts again."""
MIN_CHANGE_FRACTION = 0.3
"""Minimum change relative to the present self-discharge. Old hypotheses would otherwise hide the end of a short."""
THRESHOLD_STD = 4.0
"""Minimum significance of a change, in std."""
END_STD = 2.0
"""Minimum significance of a fall, which ends an alarm and never raises one, in std."""
MIN_INFORMATION = 1e4
"""Minimum information [h^2]: the change has a std of at most C/100. With less, a single wrong
innovation would look like a large short."""
DRAIN_MARGIN = 9.0
"""Minimum excess of the likelihood ratio (twice its logarithm) of a self-discharge over that of a balancer."""


@njit(cache=True)
def initialize_cell(c: Record) -> None:
    """Write the initial state of an unknown cell: no deviation, with the std of P(0)."""
    for i in range(STATES):
        c.mean[i] = 0.0
        for j in range(STATES):
            c.covariance[i, j] = 0.0
    c.covariance[SOC, SOC] = SOC_STD**2
    c.covariance[CAPACITY, CAPACITY] = CAPACITY_STD**2
    c.covariance[RESISTANCE, RESISTANCE] = RESISTANCE_STD**2
    c.covariance[LEAK, LEAK] = LEAK_STD**2
    c.covariance[BIAS, BIAS] = BIAS_V**2
    c.held_v = math.nan


@njit(cache=True)
def ocv_and_slope(p: Record, soc: float) -> tuple[float, float]:
    """Return the OCV of one cell at ``soc`` and its slope dE/dSOC, both in volts. The curve is extended linearly."""
    last = p.ocv_v.size - 2
    position = soc * (last + 1)
    j = min(max(int(position), 0), last)
    step_v = p.ocv_v[j + 1] - p.ocv_v[j]
    return (p.ocv_v[j] + (position - j) * step_v) / p.series, step_v * (last + 1) / p.series


@njit(cache=True)
def advance(x: Floats, b: Record) -> None:
    """Advance a state or an error of a state, shape (STATES,), over the window ``b``: F x."""
    x[SOC] += b.change * x[CAPACITY] - b.elapsed_s / HOUR_S * x[LEAK]
    x[BIAS] *= math.exp(-b.throughput / BIAS_SOC)


@njit(cache=True)
def predict_cell(c: Record, b: Record, balancing_variance: float) -> None:
    """Advance a cell's state over the window ``b``.

    ``balancing_variance`` is the variance that a balancer may have added to the SOC.
    """
    cov, hours, bias_decay = c.covariance, b.elapsed_s / HOUR_S, math.exp(-b.throughput / BIAS_SOC)
    advance(c.mean, b)
    # F has a unit diagonal except for BIAS, and two entries in the row of the SOC
    for j in range(STATES):
        cov[SOC, j] += b.change * cov[CAPACITY, j] - hours * cov[LEAK, j]
        cov[BIAS, j] *= bias_decay
    for j in range(STATES):
        cov[j, SOC] += b.change * cov[j, CAPACITY] - hours * cov[j, LEAK]
        cov[j, BIAS] *= bias_decay
    cov[SOC, SOC] += CHARGE_STD**2 * b.throughput + balancing_variance + (GAP_STD**2 if b.gap else 0.0)
    drift = RESISTANCE_DRIFT**2 * hours
    cov[RESISTANCE, RESISTANCE] = min(cov[RESISTANCE, RESISTANCE] + drift, MAX_RESISTANCE_STD**2)
    leak_drift = max(LEAK_DRIFT, min(SHORT_DRIFT_H * c.mean[LEAK] ** 2, SHORT_DRIFT * abs(c.mean[LEAK])))
    cov[LEAK, LEAK] += leak_drift**2 * hours
    cov[BIAS, BIAS] += BIAS_V**2 * (1.0 - bias_decay * bias_decay)


@njit(cache=True)
def deviation_and_slope(c: Record, p: Record, soc: float, drop_v: float) -> tuple[float, float]:
    """Return the predicted voltage of a cell minus that of the reference cell, and its derivative by the cell's SOC [V].

    Args:
        c: The cell.
        p: Settings of the pack's filter.
        soc: SOC of the reference cell.
        drop_v: Overpotential of the reference cell [V].
    """
    cell_v, cell_slope_v = ocv_and_slope(p, soc + c.mean[SOC])
    reference_v = ocv_and_slope(p, soc)[0]
    return cell_v - reference_v - c.mean[RESISTANCE] * drop_v + c.mean[BIAS], cell_slope_v


@njit(cache=True)
def expected_v(x: Floats, slope_v: float, drop_v: float) -> float:
    """Return the voltage deviation that a small state ``x``, shape (STATES,), causes: H x [V]."""
    return slope_v * x[SOC] - drop_v * x[RESISTANCE] + x[BIAS]


@njit(cache=True)
def write_ph(c: Record, slope_v: float, drop_v: float, ph: Floats) -> float:
    """Write P H' to ``ph``, shape (STATES,), and return H P H' [V^2]."""
    cov = c.covariance
    for i in range(STATES):
        ph[i] = expected_v(cov[i], slope_v, drop_v)
    return expected_v(ph, slope_v, drop_v)


@njit(cache=True)
def correct_cell(c: Record, innovation_v: float, variance_v2: float, ph: Floats) -> None:
    """Correct a cell's state by an innovation [V] of variance ``variance_v2``. ``ph`` is P H'."""
    for i in range(STATES):
        gain = ph[i] / variance_v2
        c.mean[i] += gain * innovation_v
        for j in range(STATES):
            c.covariance[i, j] -= gain * ph[j]


@njit(cache=True)
def noise_variance(drop_v: float) -> float:
    """Return the part of R that is independent in each window [V^2]. The reference cell has the overpotential ``drop_v`` [V]."""
    return READING_V**2 + (DROP_ERROR * drop_v) ** 2


@njit(cache=True)
def curve_variance(c: Record, p: Record, soc: float, soc_std: float) -> float:
    """Return the part of R that the curvature of the OCV causes [V^2]. It is nearly equal in successive windows.

    Args:
        c: The cell.
        p: Settings of the pack's filter.
        soc: SOC of the reference cell.
        soc_std: Std of this SOC.
    """
    return (curve_range_v(c, p, soc) ** 2 + pack_range_v(c, p, soc, soc_std) ** 2) / CURVE_STDS**2


@njit(cache=True)
def curve_range_v(c: Record, p: Record, soc: float) -> float:
    """Return the largest error of the tangent to the OCV curve within ``CURVE_STDS`` std of the cell's SOC [V]."""
    half = CURVE_STDS * math.sqrt(c.covariance[SOC, SOC] + KNEE_SOC**2)
    middle_v, slope_v = ocv_and_slope(p, soc + c.mean[SOC])
    above_v = ocv_and_slope(p, soc + c.mean[SOC] + half)[0]
    below_v = ocv_and_slope(p, soc + c.mean[SOC] - half)[0]
    return max(abs(above_v - middle_v - slope_v * half), abs(middle_v - below_v - slope_v * half))


@njit(cache=True)
def pack_range_v(c: Record, p: Record, soc: float, soc_std: float) -> float:
    """Return the largest change of the cell's deviation within ``CURVE_STDS`` std of the pack's SOC [V].

    At the end of a charge of LFP, the deviation of the voltage grows tenfold within a few percent of SOC.
    """
    half = CURVE_STDS * math.sqrt(soc_std**2 + KNEE_SOC**2)
    middle_v = deviation_and_slope(c, p, soc, 0.0)[0]
    return max(
        abs(deviation_and_slope(c, p, soc + half, 0.0)[0] - middle_v),
        abs(deviation_and_slope(c, p, soc - half, 0.0)[0] - middle_v),
    )


@njit(cache=True)
def is_steep_near_full(p: Record) -> bool:
    """Return True if the OCV curve is much steeper near full than in its middle, as with LFP.

    Near full, an error of the pack's SOC changes the voltage of the fullest cell relative to the others as much as a large short.
    ``p`` is a record of EKF_SETTINGS.
    """
    last = p.ocv_v.size - 1
    low, high = round(FLAT_SOC[0] * last), round(FLAT_SOC[1] * last)
    mean_slope_v = (p.ocv_v[high] - p.ocv_v[low]) / (FLAT_SOC[1] - FLAT_SOC[0])
    return (p.ocv_v[last] - p.ocv_v[last - 1]) * last > STEEP_RATIO * mean_slope_v


@njit(cache=True)
def restart_hypothesis(c: Record, h: int) -> None:
    """Start a hypothesis again: its change begins now."""
    for i in range(STATES):
        c.response[h, i] = 0.0
    c.response[h, LEAK] = 1.0 if h == RISE else -1.0 if h == FALL else 0.0
    c.score[h] = c.information[h] = 0.0


@njit(cache=True)
def predict_hypotheses(c: Record, b: Record, balancing: bool) -> None:
    """Advance the responses over the window ``b``. ``balancing`` is True if a balancer may be active."""
    for h in range(HYPOTHESES):
        advance(c.response[h], b)
    if balancing:
        c.response[DRAIN, SOC] -= b.elapsed_s / 3600.0


@njit(cache=True)
def update_hypotheses(
    c: Record, slope_v: float, drop_v: float, innovation_v: float, variance_v2: float, balancing: bool, ph: Floats
) -> None:
    """Add an innovation, which also corrects the filter, to the likelihoods of the hypotheses.

    Args:
        c: The cell; updated.
        slope_v: Derivative of the deviation by the cell's SOC [V].
        drop_v: Overpotential of the reference cell [V].
        innovation_v: Innovation [V].
        variance_v2: Variance S of the innovation [V^2].
        balancing: True if a balancer may be active. Its current is unknown, so that the innovation is not evaluated.
        ph: P H', shape (STATES,).
    """
    min_change_c = max(MIN_CHANGE_C, MIN_CHANGE_FRACTION * abs(c.mean[LEAK]))
    for h in range(HYPOTHESES):
        response = c.response[h]
        change_v = expected_v(response, slope_v, drop_v)
        if not balancing:
            c.score[h] += change_v * innovation_v / variance_v2
            c.information[h] += change_v * change_v / variance_v2
        for i in range(STATES):
            response[i] -= ph[i] / variance_v2 * change_v
        if balancing and h == DRAIN:  # its response grows while a balancer may be active; a restart would discard it
            continue
        is_too_small = not c.score[h] > min_change_c * c.information[h]  # also if it is not finite
        if is_too_small or (h == FALL and c.mean[LEAK] < MIN_CHANGE_C):  # without a self-discharge nothing can fall
            restart_hypothesis(c, h)


@njit(cache=True)
def significance(c: Record, h: int) -> float:
    """Return the significance of a hypothesis [std]."""
    return c.score[h] / math.sqrt(c.information[h]) if c.information[h] > MIN_INFORMATION else 0.0


@njit(cache=True)
def apply_changes(c: Record) -> None:
    """Correct the state of the filter by the most likely hypothesis, if it is significant."""
    rise, fall, drain = significance(c, RISE), significance(c, FALL), significance(c, DRAIN)
    best = RISE
    if drain >= rise and drain >= fall:
        best = DRAIN
    elif fall > rise:
        best = FALL
    threshold = END_STD if best == FALL else THRESHOLD_STD
    if max(rise, fall, drain) < threshold or (best == RISE and rise**2 - drain**2 < DRAIN_MARGIN):
        return
    response, change = c.response[best], c.score[best] / c.information[best]
    for i in range(STATES):
        c.mean[i] += change * response[i]
        for j in range(STATES):
            c.covariance[i, j] += response[i] * response[j] / c.information[best]
    for h in range(HYPOTHESES):
        restart_hypothesis(c, h)
