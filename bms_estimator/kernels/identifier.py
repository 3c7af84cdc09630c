"""The identifier: SOC, branch voltages and the local elements from one sample to the next, with their covariance.

An iterated extended Kalman filter on (2.1)-(2.4) with the logarithms of R_s, R_ts, tau_ts, R_tl, tau_tl as states, so
that every element is positive. What the model cannot know is a state or a noise of its own:

- The OCV curve is another cell's. Its error is a Gauss-Markov process over SOC, not over time: standing still at one
  SOC teaches nothing more about it, and so the SOC is never more certain than the curve allows.
- Two branches are not diffusion. Each branch has a process noise that follows the load, and a voltage error that keeps
  its sign for seconds, so that a thousand samples a second know no more than one.
- Elements change with SOC and temperature: their variance grows with charge moved, and with time as far as the load
  makes them visible. It grows faster while the innovations surprise (near empty).

``s`` is a record of IDENTIFIER_STATE, ``p`` of IDENTIFIER_SETTINGS. No allocation, no clock. Joseph form, symmetric.
"""

import math

from numba import njit

from bms_estimator.kernels.cell import Floats
from bms_estimator.kernels.identifier_state import (
    CURRENT_OFFSET,
    ELEMENTS,
    LN_CAPACITY,
    LN_R_S,
    LN_R_TL,
    LN_R_TS,
    LN_TAU_TL,
    LN_TAU_TS,
    OCV_ERROR,
    SOC,
    STATES,
    V_TL,
    V_TS,
)
from bms_estimator.kernels.state import Record

Elements = tuple[float, float, float, float, float, float, float]
"""R_s, R_ts, tau_ts, C_ts, R_tl, tau_tl, C_tl."""

FIRST_SAMPLE_S = 1.0
"""The first sample counts as one after a second."""
SHORTEST_STEP_S = 1e-6
ITERATIONS = 3
LARGE_SOC_STEP = 0.01
"""A correction of the SOC beyond this is iterated: the OCV's slope changes."""
CURVED_SOC_VARIANCE = 0.01**2
"""Below this variance of the SOC the OCV is straight enough."""
BOUND_STD = 0.05
"""How firmly a bound of a logarithm is held."""
REOPENED_SOC_STD = 0.003
REOPENED_LN_STD = 0.3
STATISTICS_S = 600.0
"""Memory of the innovation's dependence on current [s]."""


@njit(cache=True)
def ocv_and_slope(soc: float, ocv_v: Floats, ocv_slope_v: Floats) -> tuple[float, float]:
    """Open-circuit voltage [V] and dOCV/dSOC [V] of the grid (cubic Hermite); beyond 0..1 the end slope goes on."""
    last = ocv_v.shape[0] - 1
    if soc <= 0.0:
        return ocv_v[0] + soc * ocv_slope_v[0], ocv_slope_v[0]
    if soc >= 1.0:
        return ocv_v[last] + (soc - 1.0) * ocv_slope_v[last], ocv_slope_v[last]
    position = soc * last
    j = min(int(position), last - 1)
    t = position - j
    rise = ocv_v[j + 1] - ocv_v[j]
    left, right = ocv_slope_v[j], ocv_slope_v[j + 1]
    value = ocv_v[j] + t * t * (3.0 - 2.0 * t) * rise + t * (1.0 - t) / last * ((1.0 - t) * left - t * right)
    slope = 6.0 * t * (1.0 - t) * rise * last + (1.0 - 4.0 * t + 3.0 * t * t) * left + (3.0 * t * t - 2.0 * t) * right
    return value, slope


@njit(cache=True)
def identifier_init(s: Record, p: Record) -> None:
    """Start again from the settings; counters are kept."""
    for j in range(STATES):
        s.mean[j] = p.mean[j]
        for k in range(STATES):
            s.covariance[j, k] = 0.0
        s.covariance[j, j] = p.variance[j]
    for j in range(ELEMENTS):
        s.excitation[j] = 0.0
    s.branch = 0.0
    s.tau_ts_effect_v = 0.0
    s.tau_tl_effect_v = 0.0
    s.surprise = 0.0
    s.innovation_slope_v_a = 0.0
    s.current_square = 0.0
    s.gated_in_row = 0
    s.gated_s = 0.0
    s.started = 0
    keep(s)


@njit(cache=True)
def identifier_step(s: Record, p: Record, dt_s: float, current_a: float, voltage_v: float) -> None:
    """Take one sample.

    Args:
        s: Record of IDENTIFIER_STATE; updated in place.
        p: Record of IDENTIFIER_SETTINGS.
        dt_s: Time since the sample before [s]; any at the first one. A sample that is not later is ignored.
        current_a: Current [A], positive on discharge.
        voltage_v: Terminal voltage [V].
    """
    if not (math.isfinite(dt_s) and math.isfinite(current_a) and math.isfinite(voltage_v)):
        s.ignored += 1
        return
    if s.started == 0:
        start(s, p, current_a)
        dt_s = FIRST_SAMPLE_S
    elif dt_s < SHORTEST_STEP_S:
        s.ignored += 1
        return
    else:
        predict(s, p, dt_s, current_a)
    correct(s, p, dt_s, current_a, voltage_v)
    constrain(s, p)
    s.current_a = current_a
    guard(s, p, dt_s)


@njit(cache=True)
def start(s: Record, p: Record, current_a: float) -> None:
    """First sample: under load the branches may stand anywhere up to R i."""
    s.started = 1
    s.current_a = current_a
    s.covariance[V_TS, V_TS] = p.variance[V_TS] + (math.exp(s.mean[LN_R_TS]) * current_a) ** 2
    s.covariance[V_TL, V_TL] = p.variance[V_TL] + (math.exp(s.mean[LN_R_TL]) * current_a) ** 2


@njit(cache=True)
def predict(s: Record, p: Record, dt_s: float, current_a: float) -> None:
    """State and covariance at the new sample, before its voltage is looked at."""
    x, cov, n = s.mean, s.covariance, p.active
    i = 0.5 * (current_a + s.current_a)
    if dt_s > p.gap_s:  # what both ends agree on
        i = 0.0 if current_a * s.current_a <= 0.0 else math.copysign(min(abs(current_a), abs(s.current_a)), current_a)
    i -= x[CURRENT_OFFSET]
    ohm_ts, ohm_tl = math.exp(x[LN_R_TS]), math.exp(x[LN_R_TL])
    x_ts, x_tl = dt_s * math.exp(-x[LN_TAU_TS]), dt_s * math.exp(-x[LN_TAU_TL])
    e_ts, e_tl = math.exp(-x_ts), math.exp(-x_tl)
    capacity_as = p.capacity_as * math.exp(x[LN_CAPACITY]) if n > LN_CAPACITY else p.capacity_as
    moved = i * dt_s / capacity_as
    r_ts, r_tl = ohm_ts * (1.0 - e_ts) * i, ohm_tl * (1.0 - e_tl) * i  # dv/d ln R over the step
    t_ts, t_tl = (x[V_TS] - ohm_ts * i) * e_ts * x_ts, (x[V_TL] - ohm_tl * i) * e_tl * x_tl  # dv/d ln tau
    length = p.ocv_error_length + s.branch * (p.hysteresis_error_length - p.ocv_error_length)
    fade = math.exp(-abs(moved) / length)

    x[SOC] -= moved  # (2.1)
    x[V_TS] = e_ts * x[V_TS] + r_ts  # (2.2)
    x[V_TL] = e_tl * x[V_TL] + r_tl  # (2.3)
    x[OCV_ERROR] *= fade
    s.tau_ts_effect_v = e_ts * s.tau_ts_effect_v + t_ts
    s.tau_tl_effect_v = e_tl * s.tau_tl_effect_v + t_tl
    turn = 1.0 - math.exp(-abs(moved) / p.hysteresis_soc)
    s.branch += turn * ((1.0 if i < 0.0 else 0.0) - s.branch)

    o_s, o_ts, o_tl = dt_s / capacity_as, -ohm_ts * (1.0 - e_ts), -ohm_tl * (1.0 - e_tl)
    for k in range(n):  # rows: F P
        cov[V_TS, k] = e_ts * cov[V_TS, k] + r_ts * cov[LN_R_TS, k] + t_ts * cov[LN_TAU_TS, k]
        cov[V_TL, k] = e_tl * cov[V_TL, k] + r_tl * cov[LN_R_TL, k] + t_tl * cov[LN_TAU_TL, k]
        cov[OCV_ERROR, k] *= fade
    for k in range(n):  # columns: (F P) F'
        cov[k, V_TS] = e_ts * cov[k, V_TS] + r_ts * cov[k, LN_R_TS] + t_ts * cov[k, LN_TAU_TS]
        cov[k, V_TL] = e_tl * cov[k, V_TL] + r_tl * cov[k, LN_R_TL] + t_tl * cov[k, LN_TAU_TL]
        cov[k, OCV_ERROR] *= fade
    if n > CURRENT_OFFSET:
        spread_optional(s, n, o_s, o_ts, o_tl, moved)

    widen = 1.0 + min(p.surprise_gain * s.surprise, p.surprise_limit)
    cov[OCV_ERROR, OCV_ERROR] += 1.0 - fade * fade
    cov[V_TS, V_TS] += widen * (p.branch_v2 + (p.branch_relative * ohm_ts * i) ** 2) * (1.0 - e_ts * e_ts)
    cov[V_TL, V_TL] += widen * (p.branch_v2 + (p.branch_relative * ohm_tl * i) ** 2) * (1.0 - e_tl * e_tl)
    unknown_a = p.timing * (current_a - s.current_a)
    if dt_s > p.gap_s:
        unknown_a = 0.5 * max(abs(current_a), abs(s.current_a)) + p.idle_current_a
    cov[SOC, SOC] += p.drift_per_soc[SOC] * abs(moved) + (unknown_a * o_s) ** 2
    cov[V_TS, V_TS] += (unknown_a * o_ts) ** 2
    cov[V_TL, V_TL] += (unknown_a * o_tl) ** 2
    cov[CURRENT_OFFSET, CURRENT_OFFSET] += p.drift_per_s[CURRENT_OFFSET] * dt_s
    drift(s, p, current_a, dt_s, abs(moved) * widen)


@njit(cache=True)
def spread_optional(s: Record, n: int, o_s: float, o_ts: float, o_tl: float, moved: float) -> None:
    """Covariance through the part of F that current offset and capacity have.

    Args:
        s: Record of IDENTIFIER_STATE.
        n: States in use.
        o_s: d soc / d offset over the step [1/A].
        o_ts: d v_ts / d offset [ohm].
        o_tl: d v_tl / d offset [ohm].
        moved: d soc / d ln(capacity): the charge moved, per unit of SOC.
    """
    cov = s.covariance
    for k in range(n):
        offset = cov[CURRENT_OFFSET, k]
        cov[SOC, k] += o_s * offset + (moved * cov[LN_CAPACITY, k] if n > LN_CAPACITY else 0.0)
        cov[V_TS, k] += o_ts * offset
        cov[V_TL, k] += o_tl * offset
    for k in range(n):
        offset = cov[k, CURRENT_OFFSET]
        cov[k, SOC] += o_s * offset + (moved * cov[k, LN_CAPACITY] if n > LN_CAPACITY else 0.0)
        cov[k, V_TS] += o_ts * offset
        cov[k, V_TL] += o_tl * offset


@njit(cache=True)
def drift(s: Record, p: Record, current_a: float, dt_s: float, swept: float) -> None:
    """Variance that the elements gain, and what the load tells of them.

    Args:
        s: Record of IDENTIFIER_STATE.
        p: Record of IDENTIFIER_SETTINGS.
        current_a: Current [A].
        dt_s: Step [s].
        swept: Charge moved, per unit of SOC, widened by the surprise.
    """
    x = s.mean
    drift_one(s, p, LN_R_S, math.exp(x[LN_R_S]) * current_a, dt_s, swept)
    drift_one(s, p, LN_R_TS, x[V_TS], dt_s, swept)
    drift_one(s, p, LN_TAU_TS, s.tau_ts_effect_v, dt_s, swept)
    drift_one(s, p, LN_R_TL, x[V_TL], dt_s, swept)
    drift_one(s, p, LN_TAU_TL, s.tau_tl_effect_v, dt_s, swept)


@njit(cache=True)
def drift_one(s: Record, p: Record, j: int, effect_v: float, dt_s: float, swept: float) -> None:
    """Variance that element ``j`` gains: with charge moved, and with time as far as the load makes it visible.

    Args:
        s: Record of IDENTIFIER_STATE.
        p: Record of IDENTIFIER_SETTINGS.
        j: LN_R_S .. LN_TAU_TL.
        effect_v: Derivative of the terminal voltage by this logarithm now, of either sign [V].
        dt_s: Step [s].
        swept: Charge moved, per unit of SOC.
    """
    visible = min(1.0, (effect_v / p.excited_v) ** 2)
    s.covariance[j, j] += p.drift_per_s[j] * dt_s * visible + p.drift_per_soc[j] * swept
    info = p.noise_v2 + p.model_v2 * (1.0 + 2.0 * p.model_s / dt_s)
    e = j - LN_R_S
    s.excitation[e] += effect_v * effect_v / info - s.excitation[e] * min(1.0, dt_s / p.excitation_s)


@njit(cache=True)
def correct(s: Record, p: Record, dt_s: float, current_a: float, voltage_v: float) -> None:
    """Take the sample's voltage in, unless it is not believed."""
    x = s.mean
    i = current_a - x[CURRENT_OFFSET]
    ohm = math.exp(x[LN_R_S])
    e_o, slope = ocv_and_slope(x[SOC], p.ocv_v, p.ocv_slope_v)
    hysteresis_v = p.hysteresis_discharge_v + s.branch * (p.hysteresis_charge_v - p.hysteresis_discharge_v)
    error_soc = p.ocv_error_soc + p.capacity_spread * (1.0 - x[SOC])
    error_v2 = p.ocv_error_v**2 + (error_soc * slope) ** 2 + (s.branch * p.hysteresis_error_v) ** 2
    scale_v = math.sqrt(error_v2)
    s.voltage_v = e_o + hysteresis_v + scale_v * x[OCV_ERROR] - x[V_TS] - x[V_TL] - ohm * i  # (2.4)
    s.innovation_v = voltage_v - s.voltage_v

    drop = ohm * i
    jump = ohm * (current_a - s.current_a)
    load_v2 = (p.ohmic_relative * drop) ** 2 + (p.ohmic_step * jump) ** 2
    curved_v2 = second_order(s, p, drop, slope)
    slow_v2 = p.curvature * branch_second_order(s)
    once_v2 = p.noise_v2 + p.rounding_v2 + p.model_v2 + load_v2 + curved_v2 + slow_v2
    per_second = max(1.0, 1.0 / dt_s)
    repeated_v2 = (
        p.noise_v2
        + p.rounding_v2 * per_second
        + load_v2 * per_second
        + p.model_v2 * (1.0 + 2.0 * p.model_s / dt_s)
        + curved_v2
        + slow_v2 * (1.0 + 2.0 * p.curvature_s / dt_s)
    )
    expected_v2 = project(s, p, slope, ohm, -drop, scale_v)
    s.innovation_variance = expected_v2 + once_v2
    gate_v2 = p.gate * (s.innovation_variance + 2.0 * (p.model_v2 * p.model_s + slow_v2 * p.curvature_s))
    if s.innovation_v**2 > gate_v2:
        if not reopen(s, p, dt_s, jump, math.sqrt(gate_v2)):
            return
        expected_v2 = project(s, p, slope, ohm, -drop, scale_v)
    else:
        s.gated_in_row = 0
        s.gated_s = 0.0
    note(s, p, dt_s, current_a, p.gate * s.innovation_v**2 / gate_v2)

    total_v2 = expected_v2 + repeated_v2
    innovation_v = s.innovation_v
    if abs(s.projected[SOC] * innovation_v) > LARGE_SOC_STEP * total_v2:
        soc, ln_r_s = x[SOC], x[LN_R_S]
        rest_v = s.voltage_v - e_o + drop
        for _ in range(ITERATIONS):
            d_soc = s.projected[SOC] * innovation_v / total_v2
            d_ln = s.projected[LN_R_S] * innovation_v / total_v2
            e_o, slope = ocv_and_slope(soc + d_soc, p.ocv_v, p.ocv_slope_v)
            ohm = math.exp(ln_r_s + d_ln)
            innovation_v = voltage_v - (e_o + rest_v - ohm * i) + slope * d_soc - ohm * i * d_ln
            total_v2 = project(s, p, slope, ohm, -ohm * i, scale_v) + repeated_v2
    absorb(s, p, innovation_v, total_v2)


@njit(cache=True)
def project(s: Record, p: Record, slope: float, ohm: float, ohmic: float, scale_v: float) -> float:
    """P h into ``s.projected`` and h' P h [V^2], for the derivative h of (2.4) by the state.

    Args:
        s: Record of IDENTIFIER_STATE.
        p: Record of IDENTIFIER_SETTINGS.
        slope: dE_o/dSOC [V].
        ohm: R_s [ohm], the derivative by the current's offset.
        ohmic: -R_s i [V], the derivative by ln R_s.
        scale_v: Size of the OCV's error [V].
    """
    cov, g, n = s.covariance, s.projected, p.active
    for k in range(n):
        g[k] = slope * cov[SOC, k] - cov[V_TS, k] - cov[V_TL, k] + ohmic * cov[LN_R_S, k] + scale_v * cov[OCV_ERROR, k]
    if n > CURRENT_OFFSET:
        for k in range(n):
            g[k] += ohm * cov[CURRENT_OFFSET, k]
    total = slope * g[SOC] - g[V_TS] - g[V_TL] + ohmic * g[LN_R_S] + scale_v * g[OCV_ERROR]
    return total + ohm * g[CURRENT_OFFSET] if n > CURRENT_OFFSET else total


@njit(cache=True)
def second_order(s: Record, p: Record, drop: float, slope: float) -> float:
    """Variance of what linearising the OCV and R_s i leaves out [V^2]."""
    variance = s.covariance[SOC, SOC]
    bend = 0.0
    if variance > CURVED_SOC_VARIANCE:
        _, further = ocv_and_slope(s.mean[SOC] + 0.5 * math.sqrt(variance), p.ocv_v, p.ocv_slope_v)
        bend = (further - slope) ** 2 * variance
    return p.curvature * (bend + (drop * s.covariance[LN_R_S, LN_R_S]) ** 2)


@njit(cache=True)
def branch_second_order(s: Record) -> float:
    """Variance of what linearising the branches leaves out [V^2]: keeps its sign while the load lasts."""
    x, cov = s.mean, s.covariance
    return (
        (x[V_TS] * cov[LN_R_TS, LN_R_TS]) ** 2
        + (s.tau_ts_effect_v * cov[LN_TAU_TS, LN_TAU_TS]) ** 2
        + (x[V_TL] * cov[LN_R_TL, LN_R_TL]) ** 2
        + (s.tau_tl_effect_v * cov[LN_TAU_TL, LN_TAU_TL]) ** 2
    )


@njit(cache=True)
def reopen(s: Record, p: Record, dt_s: float, jump_v: float, limit_v: float) -> bool:
    """Whether a sample beyond the gate is taken after all, the state being widened for it.

    A voltage between what the present and the last current explain was taken before the current had changed: it is
    passed over, and its innovation is how far it lies outside. Else it is an outlier, unless there have been enough in
    a row: then the cell has changed.
    """
    before = s.innovation_v - jump_v
    if (
        abs(jump_v) > 0.5 * limit_v
        and min(s.innovation_v, before) <= limit_v
        and max(s.innovation_v, before) >= -limit_v
    ):
        inside = s.innovation_v * before <= 0.0
        s.innovation_v = 0.0 if inside else (before if abs(before) < abs(s.innovation_v) else s.innovation_v)
        s.asynchronous += 1
        return False
    s.gated += 1
    s.gated_in_row += 1
    s.gated_s += dt_s
    if s.gated_in_row < p.gate_samples or s.gated_s < p.gate_s:
        return False
    s.reopened += 1
    s.gated_in_row = 0
    s.gated_s = 0.0
    s.covariance[SOC, SOC] += REOPENED_SOC_STD**2
    s.covariance[V_TS, V_TS] += 0.25 * s.innovation_v**2
    s.covariance[V_TL, V_TL] += 0.25 * s.innovation_v**2
    for j in range(LN_R_S, LN_R_S + ELEMENTS):
        s.covariance[j, j] += REOPENED_LN_STD**2
    return True


@njit(cache=True)
def note(s: Record, p: Record, dt_s: float, current_a: float, normalised: float) -> None:
    """Running means of the squared normalised innovation and of how the innovation goes with the current."""
    s.surprise += min(1.0, dt_s / p.surprise_s) * (normalised - s.surprise)
    weight = min(1.0, dt_s / STATISTICS_S)
    s.innovation_slope_v_a += weight * (s.innovation_v * current_a - s.innovation_slope_v_a)
    s.current_square += weight * (current_a * current_a - s.current_square)


@njit(cache=True)
def absorb(s: Record, p: Record, innovation_v: float, total_v2: float) -> None:
    """Correct mean and covariance along ``s.projected``, Joseph form, both triangles from one."""
    x, cov, g, gain, n = s.mean, s.covariance, s.projected, s.gain, p.active
    for j in range(n):
        gain[j] = g[j] / total_v2
    for j in range(n):
        x[j] += gain[j] * innovation_v
        rest = g[j] - total_v2 * gain[j]
        for k in range(j, n):
            cov[j, k] -= gain[j] * g[k] + gain[k] * rest
            cov[k, j] = cov[j, k]


@njit(cache=True)
def constrain(s: Record, p: Record) -> None:
    """Keep the time constants apart, the mean within its bounds and the variances within theirs."""
    x, cov, n = s.mean, s.covariance, p.active
    if x[LN_TAU_TL] - x[LN_TAU_TS] < p.tau_ratio:
        hold(s, p, LN_TAU_TL, LN_TAU_TS, p.tau_ratio)
    for j in range(n):
        if not p.lower[j] <= x[j] <= p.upper[j]:
            bound = p.lower[j] if x[j] < p.lower[j] else p.upper[j]
            if LN_R_S <= j < LN_R_S + ELEMENTS:
                hold(s, p, j, -1, bound)
            x[j] = min(max(x[j], p.lower[j]), p.upper[j])
        if cov[j, j] > p.variance_ceiling[j]:
            shrink = math.sqrt(p.variance_ceiling[j] / cov[j, j])
            for k in range(n):
                cov[j, k] *= shrink
                cov[k, j] *= shrink
        elif cov[j, j] < p.variance_floor[j]:
            cov[j, j] = p.variance_floor[j]


@njit(cache=True)
def hold(s: Record, p: Record, j: int, less: int, value: float) -> None:
    """Correct as if x[j] - x[less] (``less`` < 0: x[j]) had been measured as ``value``."""
    x, cov, g = s.mean, s.covariance, s.projected
    for k in range(p.active):
        g[k] = cov[j, k] - (cov[less, k] if less >= 0 else 0.0)
    expected = g[j] - (g[less] if less >= 0 else 0.0)
    absorb(s, p, value - x[j] + (x[less] if less >= 0 else 0.0), expected + BOUND_STD**2)


@njit(cache=True)
def guard(s: Record, p: Record, dt_s: float) -> None:
    """Back to the last good state when anything is not finite; else keep this one now and then."""
    total = 0.0
    for j in range(p.active):
        total += s.mean[j] + s.covariance[j, j] + s.gain[j]
    if not math.isfinite(total):
        for j in range(STATES):
            s.mean[j] = s.good_mean[j]
            for k in range(STATES):
                s.covariance[j, k] = s.good_covariance[j, k]
        s.surprise = 0.0
        s.reset += 1
        return
    s.good_age_s += dt_s
    if s.good_age_s >= p.snapshot_s:
        keep(s)


@njit(cache=True)
def keep(s: Record) -> None:
    """Keep the state as the last good one."""
    for j in range(STATES):
        s.good_mean[j] = s.mean[j]
        for k in range(STATES):
            s.good_covariance[j, k] = s.covariance[j, k]
    s.good_age_s = 0.0


@njit(cache=True)
def soc(s: Record) -> float:
    """State of charge, 0..1."""
    return min(max(s.mean[SOC], 0.0), 1.0)


@njit(cache=True)
def soc_std(s: Record) -> float:
    """Standard deviation of the state of charge."""
    return math.sqrt(s.covariance[SOC, SOC])


@njit(cache=True)
def element_values(s: Record) -> Elements:
    """R_s [ohm], R_ts [ohm], tau_ts [s], C_ts [F], R_tl [ohm], tau_tl [s], C_tl [F] at the present SOC."""
    x = s.mean
    ohm_ts, tau_ts = math.exp(x[LN_R_TS]), math.exp(x[LN_TAU_TS])
    ohm_tl, tau_tl = math.exp(x[LN_R_TL]), math.exp(x[LN_TAU_TL])
    return math.exp(x[LN_R_S]), ohm_ts, tau_ts, tau_ts / ohm_ts, ohm_tl, tau_tl, tau_tl / ohm_tl


@njit(cache=True)
def element_ln_stds(s: Record) -> Elements:
    """Relative standard deviations (of the logarithms), in the order of ``element_values``."""
    cov = s.covariance
    return (
        math.sqrt(cov[LN_R_S, LN_R_S]),
        math.sqrt(cov[LN_R_TS, LN_R_TS]),
        math.sqrt(cov[LN_TAU_TS, LN_TAU_TS]),
        _ratio_std(s, LN_TAU_TS, LN_R_TS),
        math.sqrt(cov[LN_R_TL, LN_R_TL]),
        math.sqrt(cov[LN_TAU_TL, LN_TAU_TL]),
        _ratio_std(s, LN_TAU_TL, LN_R_TL),
    )


@njit(cache=True)
def _ratio_std(s: Record, j: int, k: int) -> float:
    """Standard deviation of x[j] - x[k]."""
    return math.sqrt(max(s.covariance[j, j] + s.covariance[k, k] - 2.0 * s.covariance[j, k], 0.0))


@njit(cache=True)
def nis(s: Record) -> float:
    """Innovation squared over its variance: about 1 for a cell that is as the model says, NaN before a sample."""
    return s.innovation_v**2 / s.innovation_variance if s.innovation_variance > 0.0 else math.nan
