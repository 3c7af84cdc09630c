"""Available power: constant power that the pack supplies or accepts until its voltage reaches a limit.

A search finds the largest constant current with which a given quantile of the voltage stays within the limit. Mean and variance
of the voltage come from the filter's mixture of hypotheses, propagated to the end of the current. The available power is this
current times the lowest voltage during the current. A constant power of this size never draws a larger current, and therefore
stays within the limit, too.

``s`` is a record of EKF_STATE, ``p`` of EKF_SETTINGS. Currents are positive on discharge.
"""

import math

import numpy as np

from bms_estimator.kernels.cell_model.chen_mora import ocv
from bms_estimator.kernels.cell_model.rc_ladder import BRANCHES, RESISTANCES, TAUS, on_grid
from bms_estimator.kernels.forecast.constant_current import branch_current, hypothesis_capacity, voltage_after
from bms_estimator.kernels.kalman_filter.noise import load_bias_variance
from bms_estimator.kernels.kalman_filter.ocv_correction import node_error_scale, node_position
from bms_estimator.kernels.kalman_filter.records import (
    B_FAST,
    B_SLOW,
    CURVE,
    HYST,
    LN_Q,
    LN_R,
    LN_R0,
    NODE,
    SOC,
    STATES,
    X,
)
from bms_estimator.model.arrays import Floats, Record
from bms_estimator.numba_cache import njit

CHECKED_FRACTIONS = (0.0, 1.0 / 16.0, 1.0 / 4.0, 1.0)
"""Fractions of the duration at which the voltage is checked. It is not always lowest or highest at the end: after a larger load,
the RC pairs recover while the SOC still falls."""
MAX_ITERATIONS = 24
"""Maximum number of iterations of the search for the current. About five suffice."""
TOLERANCE_V = 1e-6
"""Distance from the limit below which the search ends [V]."""
MIN_SECANT_SOC = 1e-3
"""Minimum width of the OCV's secant [SOC]. It prevents a division by a std near 0."""


@njit(cache=True)
def available_power(
    s: Record, p: Record, duration_s: float, limit_v: float, max_a: float, stds: float, scratch: Floats
) -> float:
    """Return the constant power that the pack supplies or accepts for ``duration_s`` [W], at least 0.

    Args:
        s: Record of EKF_STATE.
        p: Record of EKF_SETTINGS.
        duration_s: Duration of the power [s].
        limit_v: Voltage that must not be crossed: the lower limit on discharge, the upper one on charge [V].
        max_a: Largest current [A]; positive: discharge, negative: charge.
        stds: Distance of the voltage's quantile from its mean, in standard deviations; 0: median.
        scratch: Scratch space of shape (RESISTANCES + STATES,).
    """
    direction = math.copysign(1.0, max_a)
    rest_distance_v = direction * (closest_voltage(s, p, 0.0, duration_s, direction, stds, scratch) - limit_v)
    if max_a == 0.0 or rest_distance_v <= 0.0:
        return 0.0
    current_a = max_a
    max_distance_v = direction * (closest_voltage(s, p, max_a, duration_s, direction, stds, scratch) - limit_v)
    if max_distance_v < 0.0:
        current_a = current_at_limit(s, p, duration_s, limit_v, (max_a, rest_distance_v, max_distance_v), stds, scratch)
    if direction > 0.0:
        return current_a * closest_voltage(s, p, current_a, duration_s, direction, stds, scratch)
    return -current_a * voltage_quantile(s, p, current_a, 0.0, 0.0, scratch)  # the voltage is lowest at the beginning


@njit(cache=True)
def current_at_limit(
    s: Record,
    p: Record,
    duration_s: float,
    limit_v: float,
    bracket: tuple[float, float, float],
    stds: float,
    scratch: Floats,
) -> float:
    """Return the largest current with which the quantile of the voltage does not cross ``limit_v`` [A].

    The method is regula falsi (Illinois variant). It converges fast, because the voltage is nearly linear in the current.

    Args:
        s: Record of EKF_STATE.
        p: Record of EKF_SETTINGS.
        duration_s: Duration of the current [s].
        limit_v: Limit of the voltage [V].
        bracket: Largest current [A], and distance of the voltage from the limit at rest (above 0)
            and at this current (below 0) [V].
        stds: Distance of the quantile from the mean towards the limit, in standard deviations.
        scratch: Scratch space of shape (RESISTANCES + STATES,).
    """
    outside_a, inside_v, outside_v = bracket
    inside_a, last_side = 0.0, 0  # side of the limit in the last iteration; 1: inside, -1: outside
    direction = math.copysign(1.0, outside_a)
    for _ in range(MAX_ITERATIONS):
        middle_a = (inside_a * outside_v - outside_a * inside_v) / (outside_v - inside_v)
        distance_v = direction * (closest_voltage(s, p, middle_a, duration_s, direction, stds, scratch) - limit_v)
        if abs(distance_v) < TOLERANCE_V:
            return middle_a
        if distance_v > 0.0:
            inside_a, inside_v = middle_a, distance_v
            outside_v *= 0.5 if last_side == 1 else 1.0
            last_side = 1
        else:
            outside_a, outside_v = middle_a, distance_v
            inside_v *= 0.5 if last_side == -1 else 1.0
            last_side = -1
    return inside_a


@njit(cache=True)
def closest_voltage(
    s: Record, p: Record, current_a: float, duration_s: float, direction: float, stds: float, scratch: Floats
) -> float:
    """Return the quantile of the voltage that is closest to the limit, over the times ``CHECKED_FRACTIONS`` [V].

    Args:
        s: Record of EKF_STATE.
        p: Record of EKF_SETTINGS.
        current_a: Constant current [A].
        duration_s: Duration of the current [s].
        direction: 1: the limit is below the voltage; -1: it is above.
        stds: Distance of the quantile from the mean towards the limit, in standard deviations.
        scratch: Scratch space of shape (RESISTANCES + STATES,).
    """
    closest_v = math.inf * direction
    for fraction in CHECKED_FRACTIONS:
        voltage_v = voltage_quantile(s, p, current_a, fraction * duration_s, -direction * stds, scratch)
        if voltage_v * direction < closest_v * direction:
            closest_v = voltage_v
    return closest_v


@njit(cache=True)
def voltage_quantile(s: Record, p: Record, current_a: float, elapsed_s: float, stds: float, scratch: Floats) -> float:
    """Return mean plus ``stds`` standard deviations of the voltage after ``elapsed_s`` of the constant current [V].

    Mean and variance are those of the mixture of hypotheses.
    """
    total = mean_v = mean_square_v2 = 0.0
    reference_v = voltage_after(s, p, s.best, current_a, elapsed_s, scratch[:RESISTANCES])  # limits the rounding error
    for q in range(s.count):
        weight = math.exp(s.ln_weight[q] - s.ln_weight[s.best])
        deviation_v = voltage_after(s, p, q, current_a, elapsed_s, scratch[:RESISTANCES]) - reference_v
        variance_v2 = voltage_variance(s, p, q, current_a, elapsed_s, stds, scratch) if stds != 0.0 else 0.0
        total += weight
        mean_v += weight * deviation_v
        mean_square_v2 += weight * (variance_v2 + deviation_v * deviation_v)
    mean_v, mean_square_v2 = mean_v / total, mean_square_v2 / total
    return reference_v + mean_v + stds * math.sqrt(max(mean_square_v2 - mean_v * mean_v, 0.0))


@njit(cache=True)
def voltage_variance(
    s: Record, p: Record, q: int, current_a: float, elapsed_s: float, stds: float, scratch: Floats
) -> float:
    """Return the variance of the voltage after ``elapsed_s`` of the constant current [V^2].

    It is H P H' with the filter's covariance P, plus the variance of the model error that the current adds.

    Args:
        s: Record of EKF_STATE.
        p: Record of EKF_SETTINGS.
        q: Index of the hypothesis.
        current_a: Constant current [A].
        elapsed_s: Time from now [s].
        stds: Width of the OCV's secant in standard deviations of the SOC, towards full (positive) or empty (negative).
        scratch: Shape (RESISTANCES + STATES,); contains the resistances at the end of the current (``voltage_after``).
    """
    x, cov, ohm, h = s.mean[q], s.covariance[q], scratch[:RESISTANCES], scratch[RESISTANCES:]
    moved_soc = current_a * elapsed_s / hypothesis_capacity(s, p, q)
    soc = x[SOC] - moved_soc
    h[:] = 0.0
    secant_soc = math.copysign(max(abs(stds) * math.sqrt(cov[SOC, SOC]), MIN_SECANT_SOC), stds)
    e_o_v = ocv(soc, p.ocv_v, p.ocv_slope_v)
    h[SOC] = (ocv(soc + secant_soc, p.ocv_v, p.ocv_slope_v) - e_o_v) / secant_soc
    h[LN_Q] = h[SOC] * moved_soc
    h[LN_R0] = -ohm[0] * current_a
    for k in range(BRANCHES):
        h[X + k] = -ohm[1 + k] * math.exp(-elapsed_s / TAUS[k])
        h[LN_R] -= ohm[1 + k] * branch_current(s, q, k, current_a, elapsed_s)
    h[B_SLOW], h[B_FAST] = math.exp(-elapsed_s / p.slow_s), math.exp(-elapsed_s / p.fast_s)
    h[HYST] = s.hysteresis * on_grid(soc, p.hysteresis_v)
    h[CURVE] = on_grid(soc, p.varying_error_v)
    i, t = node_position(soc)
    node_v = node_error_scale(p, soc, t)
    h[NODE + i], h[NODE + i + 1] = (1.0 - t) * node_v, t * node_v
    variance_v2 = 0.0
    for j in range(STATES):
        if h[j] != 0.0:
            for k in range(STATES):
                variance_v2 += h[j] * cov[j, k] * h[k]
    # P contains the model error at the usual load. The decayed part of the biases is replaced by new model error.
    usual_v2 = load_bias_variance(s, p, q, s.rms_a2)
    pulse_v2 = load_bias_variance(s, p, q, max(current_a * current_a, s.rms_a2))
    renewed = 1.0 - 0.5 * (h[B_SLOW] * h[B_SLOW] + h[B_FAST] * h[B_FAST])
    return variance_v2 + (pulse_v2 - usual_v2) + renewed * usual_v2


@njit(cache=True)
def new_scratch() -> Floats:
    """Return scratch space for ``available_power``."""
    return np.empty(RESISTANCES + STATES)
