"""The identifier from one sample to the next, before the new voltage is looked at: (2.1)-(2.3) and the covariance.

``s`` is a record of IDENTIFIER_STATE, ``p`` of IDENTIFIER_SETTINGS.
"""

import math

from numba import njit

from bms_estimator.kernels.charge import LONGEST_FLOW_S, UNMEASURED_S, held_current
from bms_estimator.kernels.identifier_bias import bias, predict_biases
from bms_estimator.kernels.identifier_state import (
    CURRENT_OFFSET,
    LN_CAPACITY,
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
from bms_estimator.model.suspect import Suspect

SIGN_OF_CURRENT = int(Suspect.SIGN_OF_CURRENT)


@njit(cache=True)
def predict(s: Record, p: Record, dt_s: float, current_a: float) -> None:
    """State and covariance at the new sample, before its voltage is looked at."""
    x, cov, n = s.mean, s.covariance, p.active
    i = held_current(dt_s, s.current_a, current_a) - x[CURRENT_OFFSET]
    ohm_ts, ohm_tl = math.exp(x[LN_R_TS]), math.exp(x[LN_R_TL])
    x_ts, x_tl = dt_s * math.exp(-x[LN_TAU_TS]), dt_s * math.exp(-x[LN_TAU_TL])
    e_ts, e_tl, e_slow = math.exp(-x_ts), math.exp(-x_tl), math.exp(-dt_s / p.slow_s)
    capacity_as = p.capacity_as * math.exp(x[LN_CAPACITY]) if n > LN_CAPACITY else p.capacity_as
    moved = i * min(dt_s, LONGEST_FLOW_S) / capacity_as
    r_ts, r_tl = ohm_ts * (1.0 - e_ts) * i, ohm_tl * (1.0 - e_tl) * i  # dv/d ln R over the step
    t_ts, t_tl = (x[V_TS] - ohm_ts * i) * e_ts * x_ts, (x[V_TL] - ohm_tl * i) * e_tl * x_tl  # dv/d ln tau
    length = p.ocv_error_length + s.branch * (p.hysteresis_error_length - p.ocv_error_length)
    fade = math.exp(-abs(moved) / length)

    s.unsettled_v2 = (x[V_TS] - ohm_ts * i) ** 2 + (x[V_TL] - ohm_tl * i) ** 2
    x[SOC] -= moved  # (2.1)
    x[V_TS] = e_ts * x[V_TS] + r_ts  # (2.2)
    x[V_TL] = e_tl * x[V_TL] + r_tl  # (2.3)
    x[OCV_ERROR] *= fade
    x[V_SLOW] = e_slow * x[V_SLOW] + s.misfit * p.slow_mean * (ohm_ts + ohm_tl) * (1.0 - e_slow) * i
    s.tau_ts_effect_v = e_ts * s.tau_ts_effect_v + t_ts
    s.tau_tl_effect_v = e_tl * s.tau_tl_effect_v + t_tl
    turn = 1.0 - math.exp(-abs(moved) / p.hysteresis_soc)
    s.branch += turn * ((1.0 if i < 0.0 else 0.0) - s.branch)

    o_s, o_ts, o_tl = dt_s / capacity_as, -ohm_ts * (1.0 - e_ts), -ohm_tl * (1.0 - e_tl)
    for k in range(n):  # rows: F P
        cov[V_TS, k] = e_ts * cov[V_TS, k] + r_ts * cov[LN_R_TS, k] + t_ts * cov[LN_TAU_TS, k]
        cov[V_TL, k] = e_tl * cov[V_TL, k] + r_tl * cov[LN_R_TL, k] + t_tl * cov[LN_TAU_TL, k]
        cov[OCV_ERROR, k] *= fade
        cov[V_SLOW, k] *= e_slow
    for k in range(n):  # columns: (F P) F'
        cov[k, V_TS] = e_ts * cov[k, V_TS] + r_ts * cov[k, LN_R_TS] + t_ts * cov[k, LN_TAU_TS]
        cov[k, V_TL] = e_tl * cov[k, V_TL] + r_tl * cov[k, LN_R_TL] + t_tl * cov[k, LN_TAU_TL]
        cov[k, OCV_ERROR] *= fade
        cov[k, V_SLOW] *= e_slow
    predict_biases(s, e_ts, e_tl, r_ts, r_tl, t_ts, t_tl, fade, e_slow, o_s, o_ts, o_tl, moved)
    if n > CURRENT_OFFSET:
        spread_optional(s, n, o_s, o_ts, o_tl, moved)

    widen = 1.0 + min(p.surprise_gain * s.surprise, p.surprise_limit)
    cov[OCV_ERROR, OCV_ERROR] += 1.0 - fade * fade
    cov[V_TS, V_TS] += widen * s.misfit * (p.branch_v2 + (p.branch_relative * ohm_ts * i) ** 2) * (1.0 - e_ts * e_ts)
    cov[V_TL, V_TL] += widen * s.misfit * (p.branch_v2 + (p.branch_relative * ohm_tl * i) ** 2) * (1.0 - e_tl * e_tl)
    cov[V_SLOW, V_SLOW] += s.misfit * (p.slow_relative * (ohm_ts + ohm_tl) * i) ** 2 * (1.0 - e_slow * e_slow)
    doubt_current(s, p, dt_s, current_a, o_s, o_ts, o_tl, moved)
    drift(s, p, current_a, dt_s, abs(moved) * widen)


@njit(cache=True)
def doubt_current(
    s: Record, p: Record, dt_s: float, current_a: float, o_s: float, o_ts: float, o_tl: float, moved: float
) -> None:
    """Variance from what is not known of the current: when it changed, its error, and what it was in a gap.

    Args:
        s: Record of IDENTIFIER_STATE.
        p: Record of IDENTIFIER_SETTINGS.
        dt_s: Step [s].
        current_a: Current at its end [A].
        o_s: d soc / d offset over the step [1/A].
        o_ts: d v_ts / d offset [ohm].
        o_tl: d v_tl / d offset [ohm].
        moved: Charge moved, per unit of SOC.
    """
    cov = s.covariance
    unknown_a = p.timing * (current_a - s.current_a)
    if dt_s > UNMEASURED_S:
        unknown_a = 0.5 * max(abs(current_a), abs(s.current_a)) + p.idle_current_a
    wrong = miscount(s, o_s, moved)
    cov[SOC, SOC] += p.drift_per_soc[SOC] * abs(moved) + (unknown_a * o_s) ** 2
    cov[SOC, SOC] += (wrong + 2.0 * math.sqrt(cov[SOC, SOC])) * wrong  # the error grows by so much, always the same way
    cov[V_TS, V_TS] += (unknown_a * o_ts) ** 2
    cov[V_TL, V_TL] += (unknown_a * o_tl) ** 2


@njit(cache=True)
def miscount(s: Record, o_s: float, moved: float) -> float:
    """SOC by which this step's count is wrong, as far as the innovations tell.

    Args:
        s: Record of IDENTIFIER_STATE.
        o_s: d soc / d offset over the step [1/A].
        moved: Charge moved, per unit of SOC.
    """
    if s.suspects & SIGN_OF_CURRENT:
        return 2.0 * abs(moved)
    by_offset = abs(bias(s.offset_score, s.offset_information)) * o_s
    return max(by_offset, abs(bias(s.capacity_score, s.capacity_information) * moved))


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
    """Variance that the elements gain.

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
