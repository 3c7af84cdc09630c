"""What keeps the identifier sane for years: bounds and the last good state.

``s`` is a record of IDENTIFIER_STATE, ``p`` of IDENTIFIER_SETTINGS.
"""

import math

from numba import njit

from bms_estimator.kernels.identifier_state import CORRELATED, ELEMENTS, LN_R_S, LN_TAU_TL, LN_TAU_TS, STATES
from bms_estimator.kernels.state import Record

BOUND_STD = 0.05
"""How firmly a bound of a logarithm is held."""


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
    """Move the mean to where x[j] - x[less] (``less`` < 0: x[j]) is ``value``, the others as they go with it.

    The covariance stays: a bound says nothing new each time it is reached.
    """
    x, cov = s.mean, s.covariance
    variance = cov[j, j]
    if less >= 0:
        variance += cov[less, less] - 2.0 * cov[j, less]
    pull = (value - x[j] + (x[less] if less >= 0 else 0.0)) / (variance + BOUND_STD**2)
    for k in range(p.active):
        x[k] += pull * (cov[j, k] - (cov[less, k] if less >= 0 else 0.0))


@njit(cache=True)
def guard(s: Record, p: Record, dt_s: float) -> None:
    """Back to the last good state when anything is not finite; else keep this one now and then."""
    total = s.misfit + s.correlated + s.surprise + s.offset_score + s.capacity_score + s.change_v_a
    for j in range(p.active):
        total += s.mean[j] + s.covariance[j, j] + s.gain[j]
    if not math.isfinite(total):
        for j in range(STATES):
            s.mean[j] = s.good_mean[j]
            for k in range(STATES):
                s.covariance[j, k] = s.good_covariance[j, k]
        clear(s)
        s.reset += 1
        return
    s.good_age_s += dt_s
    if s.good_age_s >= p.snapshot_s:
        keep(s)


@njit(cache=True)
def clear(s: Record) -> None:
    """Start the statistics beside the state again; counters are kept."""
    s.tau_ts_effect_v = s.tau_tl_effect_v = 0.0
    s.surprise = 0.0
    s.misfit, s.correlated, s.believed_v, s.unsettled_v2 = 1.0, CORRELATED, 0.0, 0.0
    for j in range(STATES):
        s.offset_sense[j] = s.capacity_sense[j] = 0.0
    s.offset_information = s.capacity_information = s.offset_score = s.capacity_score = 0.0
    s.slow_v = s.slow_a = 0.0
    s.sign_evidence = s.change_v_a = s.change_a2 = 0.0
    s.outliers = s.breaks = 0.0
    s.suspects = 0


@njit(cache=True)
def keep(s: Record) -> None:
    """Keep the state as the last good one."""
    for j in range(STATES):
        s.good_mean[j] = s.mean[j]
        for k in range(STATES):
            s.good_covariance[j, k] = s.covariance[j, k]
    s.good_age_s = 0.0
