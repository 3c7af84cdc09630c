"""The identifier corrected by a sample's voltage (2.4).

``s`` is a record of IDENTIFIER_STATE, ``p`` of IDENTIFIER_SETTINGS.
"""

import math

from numba import njit

from bms_estimator.kernels.cell import ocv_and_slope
from bms_estimator.kernels.identifier_bias import correct_biases
from bms_estimator.kernels.identifier_gate import reopen
from bms_estimator.kernels.identifier_misfit import learn_misfit
from bms_estimator.kernels.identifier_state import (
    CURRENT_OFFSET,
    LN_R_S,
    LN_R_TL,
    LN_R_TS,
    LN_TAU_TL,
    LN_TAU_TS,
    OCV_ERROR,
    SOC,
    V_SLOW,
    V_TL,
    V_TS,
)
from bms_estimator.kernels.state import Record

IMPLAUSIBLE = 3.0
"""So many times its expected size no OCV curve is wrong."""
LEAST_SLOPE_V = 0.1
ITERATIONS = 3
LARGE_SOC_STEP = 0.01
"""A correction of the SOC beyond this is iterated: the OCV's slope changes."""
CURVED_SOC_VARIANCE = 0.01**2
"""Below this variance of the SOC the OCV is straight enough."""


@njit(cache=True)
def correct(s: Record, p: Record, dt_s: float, current_a: float, voltage_v: float) -> None:
    """Take the sample's voltage in, unless it is not believed."""
    x = s.mean
    i = current_a - x[CURRENT_OFFSET]
    ohm = math.exp(x[LN_R_S])
    e_o, slope = ocv_and_slope(x[SOC], p.ocv_v, p.ocv_slope_v)
    hysteresis_v = s.branch * p.hysteresis_charge_v
    error_soc = p.ocv_error_soc + p.capacity_spread * (1.0 - x[SOC])
    error_v2 = p.ocv_error_v**2 + (error_soc * slope) ** 2 + (s.branch * p.hysteresis_error_v) ** 2
    scale_v = math.sqrt(error_v2)
    s.voltage_v = e_o + hysteresis_v + scale_v * x[OCV_ERROR] - x[V_TS] - x[V_TL] - x[V_SLOW] - ohm * i  # (2.4)
    s.innovation_v = voltage_v - s.voltage_v

    drop = ohm * i
    jump = ohm * (current_a - s.current_a)
    load_v2 = (p.ohmic_relative * drop) ** 2 + (p.ohmic_step * jump) ** 2
    curved_v2 = second_order(s, p, drop, slope)
    slow_v2 = p.curvature * branch_second_order(s)
    sensor_v2 = p.noise_v2 + p.rounding_v2
    once_v2 = sensor_v2 + s.misfit * (p.model_v2 + load_v2) + curved_v2 + slow_v2
    per_second = max(1.0, 1.0 / dt_s)
    repeated_v2 = (
        p.noise_v2
        + p.rounding_v2 * per_second
        + s.misfit * (load_v2 * per_second + p.model_v2 * (1.0 + 2.0 * p.model_s / dt_s))
        + curved_v2
        + slow_v2 * (1.0 + 2.0 * p.curvature_s / dt_s)
    )
    expected_v2 = project(s, p, slope, ohm, -drop, scale_v)
    s.innovation_variance = expected_v2 + once_v2
    doubt_v2 = (1.0 - s.misfit) * (p.model_v2 + load_v2) + 2.0 * (p.model_v2 * p.model_s + slow_v2 * p.curvature_s)
    gate_v2 = p.gate * (s.innovation_variance + doubt_v2)
    if s.innovation_v**2 > gate_v2:
        if not reopen(s, p, dt_s, jump, math.sqrt(gate_v2)):
            s.believed_v = 0.0
            return
        expected_v2 = project(s, p, slope, ohm, -drop, scale_v)
    else:
        s.gated_in_row = 0
        s.gated_s = 0.0
    s.surprise += min(1.0, dt_s / p.surprise_s) * (p.gate * s.innovation_v**2 / gate_v2 - s.surprise)
    learn_misfit(s, p, dt_s, sensor_v2)
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
    correct_biases(s, p, dt_s, slope, ohm, -ohm * i, scale_v, s.innovation_v, total_v2)
    if abs(x[OCV_ERROR]) > IMPLAUSIBLE:
        doubt_count(s, p, x[OCV_ERROR] * scale_v / max(slope, LEAST_SLOPE_V))


@njit(cache=True)
def doubt_count(s: Record, p: Record, error: float) -> None:
    """The OCV curve cannot be so wrong: the SOC is, by about ``error``. Its count starts again from the voltage."""
    cov = s.covariance
    for k in range(p.active):
        cov[OCV_ERROR, k] = cov[k, OCV_ERROR] = 0.0
    cov[OCV_ERROR, OCV_ERROR] = p.variance[OCV_ERROR]
    s.mean[OCV_ERROR] = s.offset_sense[OCV_ERROR] = s.capacity_sense[OCV_ERROR] = 0.0
    cov[SOC, SOC] += error * error
    s.doubted += 1


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
        branches = cov[V_TS, k] + cov[V_TL, k] + cov[V_SLOW, k]
        g[k] = slope * cov[SOC, k] - branches + ohmic * cov[LN_R_S, k] + scale_v * cov[OCV_ERROR, k]
    if n > CURRENT_OFFSET:
        for k in range(n):
            g[k] += ohm * cov[CURRENT_OFFSET, k]
    total = slope * g[SOC] - g[V_TS] - g[V_TL] - g[V_SLOW] + ohmic * g[LN_R_S] + scale_v * g[OCV_ERROR]
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
def absorb(s: Record, p: Record, innovation_v: float, total_v2: float) -> None:
    """Correct mean and covariance for g = P h in ``s.projected`` and the gain K = g / S, both triangles from one.

    Joseph's form (I - K h') P (I - K h')' + K R K', multiplied out with S = h' P h + R: P - K g' - g K' + S K K'.
    So the rounding of K changes P in second order only. Multiplied out it is no sum of positive terms any more: that the
    variances stay positive is seen to by ``constrain``.
    """
    x, cov, g, gain, n = s.mean, s.covariance, s.projected, s.gain, p.active
    for j in range(n):
        gain[j] = g[j] / total_v2
    for j in range(n):
        x[j] += gain[j] * innovation_v
        rest = g[j] - total_v2 * gain[j]  # 0 but for the rounding of K
        for k in range(j, n):
            cov[j, k] -= gain[j] * g[k] + gain[k] * rest
            cov[k, j] = cov[j, k]
