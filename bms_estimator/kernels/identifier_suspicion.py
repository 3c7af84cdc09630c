"""What the identifier suspects of its input: running statistics of a few nanoseconds a sample, and the bits they set.

Each bit is set and taken back at levels of its own, apart enough that it does not flicker. The levels lie above what
captures of healthy cells under loads of all kinds reach from starts wrong by a factor of two: squared biases of 5
variances, 2 outliers in an hour, 1 break.

``s`` is a record of IDENTIFIER_STATE, ``p`` of IDENTIFIER_SETTINGS.
"""

import math

from numba import njit

from bms_estimator.kernels.charge import UNMEASURED_S
from bms_estimator.kernels.identifier_bias import significance
from bms_estimator.kernels.identifier_state import LN_R_S, LN_R_TL, LN_R_TS
from bms_estimator.kernels.state import Record
from bms_estimator.model.suspect import Suspect

FAST_S = 10.0
"""Changes of voltage and current within this time belong together [s]."""
SIGN_S = 300.0
"""Memory of how the voltage goes with the current, counted while it changes [s]."""
LEAST_EVIDENCE = 0.1
"""Share of that memory which must be filled."""
CLIP = 5.0
"""A change of voltage counts up to so many times what the declared resistances explain: not a glitch to zero."""
OUTLIERS_S = 3600.0
MANY_OUTLIERS = 5.0
FEW_OUTLIERS = 1.0
BREAKS_S = 20.0 * 3600.0
"""Memory of events that only a wrong OCV explains time after time [s]."""
MANY_BREAKS = 1.6
FEW_BREAKS = 0.5
DRIFTING = 10.0
"""Squared bias over its variance."""
NOT_DRIFTING = 4.0
ALIKE = 2.0
"""Of two explanations whose significances differ by less than this factor, neither is ruled out."""
POSSIBLE_LN_CAPACITY = 0.5
"""No capacity is declared wrong by more: then the OCV is wrong."""

SIGN_OF_CURRENT, OFFSET, CAPACITY, OCV, OUTLIERS = (int(bit) for bit in Suspect)


@njit(cache=True)
def watch(s: Record, p: Record, dt_s: float, current_a: float, voltage_v: float) -> None:
    """Take a sample, believed or not, and set or take back the bits of ``s.suspects``."""
    watch_sign(s, p, dt_s, current_a, voltage_v)
    lonely = s.asynchronous - s.seen_asynchronous
    s.seen_asynchronous = s.asynchronous
    if s.gated_in_row == 0:
        if s.reopened == s.seen_reopened:
            lonely += s.gated - s.seen_gated
        s.seen_gated = s.gated
    s.outliers += lonely - s.outliers * min(1.0, dt_s / OUTLIERS_S)
    broken = (s.doubted - s.seen_doubted + s.reopened - s.seen_reopened) * (1.0 - s.branch)  # charge has its own OCV
    s.seen_doubted = s.doubted
    s.seen_reopened = s.reopened
    s.breaks += broken - s.breaks * min(1.0, dt_s / BREAKS_S)
    s.suspects = judge(s)


@njit(cache=True)
def watch_sign(s: Record, p: Record, dt_s: float, current_a: float, voltage_v: float) -> None:
    """How fast changes of the voltage go with those of the current: by -R_s when the sign is right."""
    if dt_s > UNMEASURED_S or s.slow_v == 0.0:  # a gap, or the first sample
        s.slow_v, s.slow_a = voltage_v, current_a
        return
    ohm = math.exp(p.mean[LN_R_S]) + math.exp(p.mean[LN_R_TS]) + math.exp(p.mean[LN_R_TL])
    change_a = current_a - s.slow_a
    limit_v = CLIP * ohm * abs(change_a)
    change_v = min(max(voltage_v - s.slow_v, -limit_v), limit_v)
    share = min(1.0, dt_s / FAST_S)
    s.slow_v += share * (voltage_v - s.slow_v)
    s.slow_a += share * change_a
    visible = min(1.0, (ohm * change_a / p.excited_v) ** 2)
    weight = visible * min(1.0, dt_s / SIGN_S)
    s.sign_evidence += weight * (1.0 - s.sign_evidence)
    s.change_v_a += weight * (change_v * change_a - s.change_v_a)
    s.change_a2 += weight * (change_a * change_a - s.change_a2)


@njit(cache=True)
def judge(s: Record) -> int:
    """The bits, given those set before."""
    before = s.suspects
    bits = 0
    slope_v_a = 0.25 * math.exp(s.mean[LN_R_S]) * s.change_a2
    if s.change_v_a > (0.0 if before & SIGN_OF_CURRENT else slope_v_a) and s.sign_evidence > LEAST_EVIDENCE:
        return SIGN_OF_CURRENT
    if s.outliers > (FEW_OUTLIERS if before & OUTLIERS else MANY_OUTLIERS):
        bits |= OUTLIERS
    by_offset = significance(s.offset_score, s.offset_information)
    by_capacity = significance(s.capacity_score, s.capacity_information)
    drift = max(by_offset, by_capacity)
    broken = s.breaks > (FEW_BREAKS if before & OCV else MANY_BREAKS)
    drifting = drift > (NOT_DRIFTING if broken or before & (OFFSET | CAPACITY) else DRIFTING)
    if drifting and by_capacity * ALIKE > by_offset:
        if abs(s.capacity_score) > POSSIBLE_LN_CAPACITY * s.capacity_information:
            return bits | OCV
        bits |= CAPACITY
    if drifting and by_offset * ALIKE > by_capacity:
        bits |= OFFSET
    return bits | OCV if broken else bits
