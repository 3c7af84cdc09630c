"""What an offset of the current or a wrong capacity would have done to the innovations, and how much of it is there.

The filter counts charge as if current and capacity were right. Beside it runs, for each of the two, the sensitivity of
its error to a constant bias (Friedland 1969): it grows as the count goes wrong and shrinks as samples correct it. Least
squares of the innovations on the sensitivities gives the biases; it does not touch the state.

``s`` is a record of IDENTIFIER_STATE, ``p`` of IDENTIFIER_SETTINGS.
"""

from numba import njit

from bms_estimator.kernels.identifier_state import (
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

SIGNIFICANT = 8.0
"""Squared bias over its variance: below, it may be the error of the OCV curve."""
SENSED = 10
"""States that a bias works on: all but the optional ones."""


@njit(cache=True)
def predict_biases(
    s: Record,
    e_ts: float,
    e_tl: float,
    r_ts: float,
    r_tl: float,
    t_ts: float,
    t_tl: float,
    fade: float,
    e_slow: float,
    o_s: float,
    o_ts: float,
    o_tl: float,
    moved: float,
) -> None:
    """Both sensitivities through the step that ``predict`` makes.

    Args:
        s: Record of IDENTIFIER_STATE.
        e_ts: Decay of v_ts over the step; also its derivative by itself.
        e_tl: The same of v_tl.
        r_ts: d v_ts / d ln R_ts [V].
        r_tl: d v_tl / d ln R_tl [V].
        t_ts: d v_ts / d ln tau_ts [V].
        t_tl: d v_tl / d ln tau_tl [V].
        fade: Decay of the OCV's error.
        e_slow: Decay of v_slow.
        o_s: d soc / d offset [1/A].
        o_ts: d v_ts / d offset [ohm].
        o_tl: d v_tl / d offset [ohm].
        moved: d soc / d ln(capacity): the charge moved, per unit of SOC.
    """
    for z in (s.offset_sense, s.capacity_sense):
        z[V_TS] = e_ts * z[V_TS] + r_ts * z[LN_R_TS] + t_ts * z[LN_TAU_TS]
        z[V_TL] = e_tl * z[V_TL] + r_tl * z[LN_R_TL] + t_tl * z[LN_TAU_TL]
        z[OCV_ERROR] *= fade
        z[V_SLOW] *= e_slow
    s.offset_sense[SOC] += o_s
    s.offset_sense[V_TS] += o_ts
    s.offset_sense[V_TL] += o_tl
    s.capacity_sense[SOC] += moved


@njit(cache=True)
def correct_biases(
    s: Record,
    p: Record,
    dt_s: float,
    slope: float,
    ohm: float,
    ohmic: float,
    scale_v: float,
    innovation_v: float,
    total_v2: float,
) -> None:
    """Take a believed innovation in, after ``s.gain`` has been applied to the state.

    Args:
        s: Record of IDENTIFIER_STATE.
        p: Record of IDENTIFIER_SETTINGS.
        dt_s: Step [s].
        slope: dE_o/dSOC [V].
        ohm: R_s, the derivative of the voltage by the offset [ohm].
        ohmic: -R_s i, the derivative by ln R_s [V].
        scale_v: Size of the OCV's error [V].
        innovation_v: Measured less predicted voltage [V].
        total_v2: Its variance, errors that keep their sign included [V^2].
    """
    a, b = s.offset_sense, s.capacity_sense
    effect_a = slope * a[SOC] - a[V_TS] - a[V_TL] - a[V_SLOW] + ohmic * a[LN_R_S] + scale_v * a[OCV_ERROR] + ohm
    effect_b = slope * b[SOC] - b[V_TS] - b[V_TL] - b[V_SLOW] + ohmic * b[LN_R_S] + scale_v * b[OCV_ERROR]
    for j in range(SENSED):
        a[j] -= s.gain[j] * effect_a
        b[j] -= s.gain[j] * effect_b
    keep = 1.0 - min(1.0, dt_s / p.bias_s)
    weight = 1.0 / (total_v2 * (1.0 + p.surprise_gain * s.surprise))
    s.offset_information = s.offset_information * keep + effect_a * effect_a * weight
    s.capacity_information = s.capacity_information * keep + effect_b * effect_b * weight
    s.offset_score = s.offset_score * keep + effect_a * innovation_v * weight
    s.capacity_score = s.capacity_score * keep + effect_b * innovation_v * weight


@njit(cache=True)
def significance(score: float, information: float) -> float:
    """Squared bias over its variance."""
    return score * score / information if information > 0.0 else 0.0


@njit(cache=True)
def bias(score: float, information: float) -> float:
    """Least-squares bias, as far as it stands out of its noise; 0 when it does not."""
    squared = score * score
    if squared <= SIGNIFICANT * information:
        return 0.0
    return score / information * (1.0 - SIGNIFICANT * information / squared)
