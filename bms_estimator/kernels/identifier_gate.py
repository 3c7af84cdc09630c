"""Samples that the identifier does not believe, and when it does after all.

``s`` is a record of IDENTIFIER_STATE, ``p`` of IDENTIFIER_SETTINGS.
"""

from numba import njit

from bms_estimator.kernels.identifier_state import ELEMENTS, LN_R_S, SOC, V_TL, V_TS
from bms_estimator.kernels.state import Record

REOPENED_SOC_STD = 0.003
REOPENED_LN_STD = 0.3


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
