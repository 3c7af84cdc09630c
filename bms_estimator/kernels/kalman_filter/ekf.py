"""One extended Kalman filter: predict with F and Q, update with H, R, S and K.

``s`` is a record of EKF_STATE, ``p`` of EKF_SETTINGS, ``q`` one of its hypotheses. No allocation, no clock.
"""

import math

from bms_estimator.kernels.cell_model.chen_mora import ocv
from bms_estimator.kernels.cell_model.rc_ladder import BRANCHES, REFERENCE_C, TAUS, TREND, on_grid, resistances
from bms_estimator.kernels.kalman_filter.noise import add_process_noise, bias_variance, resistance_std
from bms_estimator.kernels.kalman_filter.ocv_correction import node_error_scale, node_position, ocv_correction
from bms_estimator.kernels.kalman_filter.records import (
    B_FAST,
    B_SLOW,
    CURVE,
    HYST,
    LN_Q,
    LN_R,
    LN_R0,
    NODE,
    OFFSET,
    SOC,
    STATES,
    X,
)
from bms_estimator.model.arrays import Floats, Record
from bms_estimator.numba_cache import njit

NARROWEST, WIDEST = 0.02, 0.3
"""The OCV's slope is that of the secant over one std of SOC, between these."""
MIN_SLOPE_V = 0.02
"""Minimum slope of the OCV of one cell [V per unit SOC]; on a flat plateau the filter would diverge."""
HUBER = 2.0
"""Limit of an innovation in std; a larger one counts as this much (Huber)."""
MINUTE_S, TEN_MINUTES_S = 60.0, 600.0
"""Averaging times over which a mean innovation shows a persistent error [s]."""
INFLATION_OVER = 5.0, 3.0
"""Averaging time of the inflation, in multiples of its own time constant."""
NEAR, MAX_TIMES = 0.01, 8
"""Convergence limit in SOC and maximum number of iterations, as an update is linearized again about its result."""
LOWEST, HIGHEST = -0.05, 1.05
"""Limits of a filter's SOC."""
MAX_STDS = 3.0
"""Limit of ln of the resistances in multiples of their initial std."""
MIN_LN_Q, MAX_LN_Q = math.log(0.5), math.log(1.3)
"""Limits of the learned relative to the declared capacity: aging takes up to half of it, and no make exceeds its
declaration by much."""
HOLD_NOTHING, HOLD_CAPACITY, HOLD_CELL, HOLD_CELL_AND_CURVE = range(4)
"""States that an update keeps: none; LN_Q; LN_Q, OFFSET and the learned nodes; these and CURVE."""
OWN_R_STD = 0.5
"""Std of ln R that series resistance and branches have each of their own. What exceeds it is common: the size of the cell.
A cell file with more is of no cell that was measured."""
REST_C, SMALL_C, NEARLY_FULL = 0.02, 0.4, 0.9
"""Currents below which the overpotential does not hide the capacity: above an SOC of ``NEARLY_FULL``, and elsewhere [C]."""
CHARGE, CHARGE_C = TREND + 1, 0.04
"""The branch of 500 s, and the current in it of a charge that is no regeneration [C]."""
VARYING_C = 0.2
"""Minimum standard deviation over 10 min of a load that distinguishes resistance from capacity [C]."""


@njit(cache=True)
def transition_diagonal(s: Record, p: Record) -> None:
    """Write the diagonal of F over the window to ``s.f``; only the element of CURVE differs between hypotheses."""
    f, dt_s, through = s.f, s.window.time_s, s.window.throughput_as / p.capacity_as
    for j in range(STATES):
        f[j] = 1.0
    for k in range(BRANCHES):
        f[X + k] = math.exp(-dt_s / TAUS[k])
    f[B_SLOW], f[B_FAST] = math.exp(-dt_s / p.slow_s), math.exp(-dt_s / p.fast_s)
    f[HYST] = math.exp(-abs(hysteresis_charge(s, p)) / p.capacity_as / p.hysteresis_soc)
    f[OFFSET], f[LN_Q] = math.exp(-dt_s / p.offset_s), math.exp(-through / p.aged_soc)
    if not s.sensed:
        f[LN_R0] = f[LN_R] = math.exp(-dt_s / p.unsensed_s)


@njit(cache=True)
def hysteresis_charge(s: Record, p: Record) -> float:
    """Charge that moves the hysteresis in the window [A s]: of the current's trend, for no regeneration turns it."""
    w = s.window
    return w.charge_as if w.gap and w.time_s > p.unmeasured_s else s.x_a[TREND] * w.time_s


@njit(cache=True)
def predict(s: Record, p: Record, q: int) -> None:
    """Mean and covariance over the window: x = f(x), P = F P F' + Q.

    F is diagonal but for what offset and capacity do to the SOC, and the offset to the branches.
    """
    x, cov, f, w = s.mean[q], s.covariance[q], s.f, s.window
    bias_v2 = bias_variance(s, p, q)
    capacity_as = p.capacity_as * math.exp(x[LN_Q])
    moved = (w.charge_as - x[OFFSET] * w.time_s) / capacity_as
    f[CURVE] = math.exp(-w.throughput_as / p.capacity_as / on_grid(x[SOC], p.curve_soc))
    for j in range(NODE):  # of the nodes it is 1
        x[j] *= f[j]
    for j in range(STATES):
        along, row = f[j], cov[j]
        for k in range(STATES if j < NODE else NODE):
            row[k] *= along * f[k]
    x[SOC] -= moved  # (2.1)
    x[HYST] -= math.copysign(1.0 - f[HYST], hysteresis_charge(s, p))
    for k in range(X, X + BRANCHES):
        x[k] -= (1.0 - f[k]) * x[OFFSET]
    apply_offdiagonal_transition(cov, f, w.time_s / capacity_as, moved)
    add_process_noise(s, p, q, w.throughput_as / capacity_as, bias_v2)


@njit(cache=True)
def apply_offdiagonal_transition(cov: Floats, f: Floats, by_offset: float, moved: float) -> None:
    """Apply the off-diagonal elements of F: SOC by offset [1/A] and ln Q, branches by offset."""
    for k in range(STATES):
        cov[SOC, k] += by_offset * cov[OFFSET, k] + moved * cov[LN_Q, k]
        for j in range(X, X + BRANCHES):
            cov[j, k] -= (1.0 - f[j]) * cov[OFFSET, k]
    for k in range(STATES):
        cov[k, SOC] += by_offset * cov[k, OFFSET] + moved * cov[k, LN_Q]
        for j in range(X, X + BRANCHES):
            cov[k, j] -= (1.0 - f[j]) * cov[k, OFFSET]
    for j in range(SOC, X + BRANCHES):  # rounded otherwise above
        for k in range(j):
            cov[j, k] = cov[k, j]
        for k in range(X + BRANCHES, STATES):
            cov[k, j] = cov[j, k]


@njit(cache=True)
def update(s: Record, p: Record, q: int, variance_v2: float) -> tuple[float, float, float]:
    """Apply the mean voltage of the window: the EKF's update, linear over the posterior SOC.

    On a bend of the OCV the secant over the prior SOC may be many times too steep (posterior linearisation:
    Garcia-Fernandez et al., IEEE Trans. Signal Process. 63, 2015).

    Args:
        s: Record of EKF_STATE.
        p: Record of EKF_SETTINGS.
        q: Hypothesis.
        variance_v2: R [V^2].

    Returns:
        Of the last linearisation: the innovation [V], its variance S, and S without what the OCV's secant leaves out [V^2].
    """
    x, cov, ph = s.mean[q], s.covariance[q], s.ph
    soc, variance = x[SOC], cov[SOC, SOC]
    innovation_v, total_v2, straight_v2 = compute_innovation(s, p, q, variance_v2, soc, variance)
    for _ in range(MAX_TIMES):
        to_soc = min(max(x[SOC] + ph[SOC] * innovation_v / total_v2, LOWEST), HIGHEST)
        to_variance = cov[SOC, SOC] - ph[SOC] * ph[SOC] / total_v2
        if max(abs(to_soc - soc), abs(secant_reach(to_variance) - secant_reach(variance))) < NEAR:
            break
        soc, variance = to_soc, to_variance
        innovation_v, total_v2, straight_v2 = compute_innovation(s, p, q, variance_v2, soc, variance)
    apply_correction(x, cov, ph, innovation_v, total_v2, states_to_hold(s, p, q))
    x[LN_Q] = min(max(x[LN_Q], MIN_LN_Q), MAX_LN_Q)
    most = MAX_STDS * resistance_std(s, p)
    for j in (LN_R0, LN_R):
        x[j] = min(max(x[j], -most), most)
    return innovation_v, total_v2, straight_v2


@njit(cache=True)
def compute_innovation(
    s: Record, p: Record, q: int, variance_v2: float, about_soc: float, about_variance: float
) -> tuple[float, float, float]:
    """Compute the innovation for ``update``, linearized about an SOC; write P H' to ``s.ph``."""
    cov, h, ph = s.covariance[q], s.h, s.ph
    predicted_v, curved_v = linearise(s, p, q, about_soc, about_variance)
    innovation_v = s.window.sum_v / s.window.samples - predicted_v
    straight_v2 = variance_v2
    for j in range(STATES):
        ph[j] = 0.0
    for k in range(STATES):
        if h[k] != 0.0:  # of the nodes two
            for j in range(STATES):
                ph[j] += cov[k, j] * h[k]
    for j in range(STATES):
        straight_v2 += h[j] * ph[j]
    least_v2 = (innovation_v / HUBER) ** 2
    return innovation_v, max(straight_v2 + curved_v * curved_v, least_v2), max(straight_v2, least_v2)


@njit(cache=True)
def secant_reach(variance: float) -> float:
    """Return the distance on both sides over which the OCV is linearized, by the variance of the SOC."""
    return min(max(math.sqrt(variance), NARROWEST), WIDEST)


@njit(cache=True)
def linearise(s: Record, p: Record, q: int, about_soc: float, about_variance: float) -> tuple[float, float]:
    """Predicted mean voltage of the window [V], H into ``s.h``, and what the secant of the OCV leaves out [V].

    All of it linear about ``about_soc``, known to ``about_variance``: the voltage is what that line has at the filter's SOC.

    v = E_o(z, T) + M h + c e - e^s0 R_0 i - e^s sum R_k x_k + b_slow + b_fast, (2.4) with the ladder. H excludes the
    change of the resistances and of the learned OCV over SOC, because their errors would be taken for errors of the
    SOC.
    """
    x, h, ohm, w = s.mean[q], s.h, s.ohm, s.window
    soc = about_soc + (w.charge_as - w.sum_as / w.samples) / p.capacity_as  # in the middle of the samples
    resistances(soc, p.weak_ohm, p.strong_ohm, s.weak, s.strong, ohm)
    reach = secant_reach(about_variance)
    e_o, above, below = (
        ocv(soc, p.ocv_v, p.ocv_slope_v),
        ocv(soc + reach, p.ocv_v, p.ocv_slope_v),
        ocv(soc - reach, p.ocv_v, p.ocv_slope_v),
    )
    for j in range(STATES):
        h[j] = 0.0
    h[SOC] = max(0.5 * (above - below) / reach, MIN_SLOPE_V * p.series)
    first, others = math.exp(x[LN_R0]), math.exp(x[LN_R])
    h[LN_R0] = -first * ohm[0] * (w.sum_a / w.samples - x[OFFSET])
    for k in range(BRANCHES):
        h[X + k] = -others * ohm[1 + k]
        h[LN_R] += h[X + k] * (w.sum_x_a[k] / w.samples + x[X + k])
    h[OFFSET] = first * ohm[0]
    h[B_SLOW] = h[B_FAST] = 1.0
    h[HYST] = s.hysteresis * on_grid(soc, p.hysteresis_v)
    h[CURVE] = math.sqrt(1.0 - p.learned) * on_grid(soc, p.curve_error_v)
    i, t = node_position(soc)
    node_v = node_error_scale(p, soc, t)
    h[NODE + i], h[NODE + i + 1] = (1.0 - t) * node_v, t * node_v
    voltage_v = e_o + h[HYST] * x[HYST] + h[CURVE] * x[CURVE] + h[LN_R0] + h[LN_R] + x[B_SLOW] + x[B_FAST]
    voltage_v += ocv_correction(p, x, soc) + (s.temperature_c - REFERENCE_C) * on_grid(soc, p.per_kelvin_v)
    voltage_v += h[SOC] * (x[SOC] - about_soc)
    return voltage_v, 0.5 * (above + below - 2.0 * e_o) * min(about_variance / (reach * reach), 1.0)


@njit(cache=True)
def update_state_directly(s: Record, q: int, j: int, value: float, variance: float) -> None:
    """State ``j`` of hypothesis ``q`` is ``value``, to ``variance``: a textbook update, linear."""
    x, cov, ph = s.mean[q], s.covariance[q], s.ph
    for k in range(STATES):
        ph[k] = cov[j, k]
    apply_correction(x, cov, ph, value - x[j], cov[j, j] + variance, HOLD_NOTHING)


@njit(cache=True)
def states_to_hold(s: Record, p: Record, q: int) -> int:
    """Return which states a voltage must not change, ``HOLD_NOTHING`` to ``HOLD_CELL_AND_CURVE``.

    A SOC outside 0..1 is limited, so the voltage error there is not one of the sensor, the capacity or the curve.
    Where resistances are hardly known, resistance and capacity change the voltage alike under a large constant current, and
    so does a charge at a constant voltage. The capacity is then learned at rest, at small currents and while a discharge varies.
    """
    soc, one_c = s.mean[q, SOC], p.capacity_as / 3600.0
    if not 0.0 <= soc <= 1.0:
        return HOLD_CELL_AND_CURVE if s.x_a[CHARGE] < -CHARGE_C * one_c else HOLD_CELL
    if p.r_std <= OWN_R_STD:
        return HOLD_NOTHING
    small_a = REST_C * one_c if soc > NEARLY_FULL else SMALL_C * one_c
    varying = s.x_a[TREND] > 0.0 and s.rms_a2 - s.mean_a * s.mean_a > (VARYING_C * one_c) ** 2
    return HOLD_NOTHING if abs(s.x_a[TREND]) < small_a or varying else HOLD_CAPACITY


@njit(cache=True)
def is_held(j: int, hold: int) -> bool:
    """Return true where state ``j`` keeps its mean and variance."""
    if j == LN_Q:
        return hold >= HOLD_CAPACITY
    if j == CURVE:
        return hold >= HOLD_CELL_AND_CURVE
    return (j == OFFSET or j >= NODE) and hold >= HOLD_CELL


@njit(cache=True)
def apply_correction(x: Floats, cov: Floats, ph: Floats, innovation: float, variance: float, hold: int) -> None:
    """State and P by an innovation e of variance S: x + P H' e / S, P - P H' H P / S. ``ph`` is P H', and scratch afterwards.

    States that are held keep their mean and covariance: their gain is 0 (Schmidt-Kalman filter).
    """
    scale = 1.0 / math.sqrt(variance)
    for j in range(STATES):
        ph[j] *= scale
    for j in range(STATES):
        along, row, held = ph[j], cov[j], is_held(j, hold)
        if not held:
            x[j] += along * scale * innovation
        for k in range(STATES):
            if not (held and is_held(k, hold)):
                row[k] -= along * ph[k]  # the same at k, j to the last bit
    x[SOC] = min(max(x[SOC], LOWEST), HIGHEST)


@njit(cache=True)
def adapt_bias_inflation(s: Record, q: int, dt_s: float, u: float) -> None:
    """Let the variance of the biases follow what innovations have in common over a minute and over ten.

    The mean over a time T of a white, normalised innovation has the variance a / (2 - a) with a = dt / T, where samples are
    equally far apart; each follows its own ratio to that.

    Args:
        s: Record of EKF_STATE.
        q: Hypothesis.
        dt_s: Step [s].
        u: Innovation over its std.
    """
    a, b = min(1.0, dt_s / MINUTE_S), min(1.0, dt_s / TEN_MINUTES_S)
    s.minute_u[q] += a * (u - s.minute_u[q])
    s.ten_minutes_u[q] += b * (u - s.ten_minutes_u[q])
    fast, slow = (2.0 - a) / a * s.minute_u[q] ** 2, (2.0 - b) / b * s.ten_minutes_u[q] ** 2
    s.fast_inflation[q] += min(1.0, dt_s / (INFLATION_OVER[0] * MINUTE_S)) * (max(fast, 1.0) - s.fast_inflation[q])
    s.slow_inflation[q] += min(1.0, dt_s / (INFLATION_OVER[1] * TEN_MINUTES_S)) * (max(slow, 1.0) - s.slow_inflation[q])
