"""Mixture of hypotheses, one row of EKF_STATE each: removal of unlikely hypotheses, and merging of similar ones.

``s`` is a record of EKF_STATE.
"""

import math

from bms_estimator.kernels.kalman_filter.records import SOC, STATES
from bms_estimator.model.arrays import Record
from bms_estimator.numba_cache import njit

MIN_LN_WEIGHT = -9.0
"""Minimum log-weight of a hypothesis, relative to the most likely one. A hypothesis below it is removed."""
MERGE_STDS = 0.7
"""SOC distance below which two neighboring hypotheses are merged, in multiples of the smaller SOC std of the two."""


@njit(cache=True)
def scale_state(mean: Record, covariance: Record, j: int, factor: float) -> None:
    """Multiply state ``j`` by a factor, with its variance and covariances."""
    mean[j] *= factor
    covariance[j, :] *= factor
    covariance[:, j] *= factor


@njit(cache=True)
def copy_hypothesis(s: Record, source: int, to: int) -> None:
    """Copy hypothesis ``source`` to ``to``."""
    s.mean[to, :] = s.mean[source, :]
    s.covariance[to, :, :] = s.covariance[source, :, :]
    s.ln_weight[to] = s.ln_weight[source]
    s.minute_u[to], s.ten_minutes_u[to] = s.minute_u[source], s.ten_minutes_u[source]
    s.fast_inflation[to], s.slow_inflation[to] = s.fast_inflation[source], s.slow_inflation[source]


@njit(cache=True)
def clear_hypothesis(s: Record, q: int) -> None:
    """Set row ``q`` to 0, because zeros need no space in a compressed checkpoint."""
    s.mean[q, :] = 0.0
    s.covariance[q, :, :] = 0.0
    s.ln_weight[q] = s.minute_u[q] = s.ten_minutes_u[q] = s.fast_inflation[q] = s.slow_inflation[q] = 0.0


@njit(cache=True)
def prune_and_merge(s: Record) -> None:
    """Remove unlikely hypotheses, and merge similar neighbors."""
    top, q = s.ln_weight[s.best], 0
    while q < s.count:
        s.ln_weight[q] -= top
        if s.ln_weight[q] < MIN_LN_WEIGHT:
            remove_hypothesis(s, q)
        else:
            q += 1
    q = 1
    while q < s.count:
        distance = abs(s.mean[q, SOC] - s.mean[q - 1, SOC])
        if distance * distance < MERGE_STDS**2 * min(s.covariance[q, SOC, SOC], s.covariance[q - 1, SOC, SOC]):
            merge_pair(s, q - 1, q)
            remove_hypothesis(s, q)
        else:
            q += 1


@njit(cache=True)
def merge_pair(s: Record, a: int, b: int) -> None:
    """Replace hypothesis ``a`` by the normal distribution with mean and covariance of the mixture of ``a`` and ``b``."""
    max_ln_weight = max(s.ln_weight[a], s.ln_weight[b])
    weight_a, weight_b = math.exp(s.ln_weight[a] - max_ln_weight), math.exp(s.ln_weight[b] - max_ln_weight)
    share = weight_b / (weight_a + weight_b)
    difference = s.ph  # scratch space
    for j in range(STATES):
        difference[j] = s.mean[b, j] - s.mean[a, j]
        s.mean[a, j] += share * difference[j]
    for j in range(STATES):
        for k in range(j, STATES):
            mean = s.covariance[a, j, k] + share * (s.covariance[b, j, k] - s.covariance[a, j, k])
            s.covariance[a, j, k] = s.covariance[a, k, j] = mean + share * (1.0 - share) * difference[j] * difference[k]
    s.ln_weight[a] = max_ln_weight + math.log(weight_a + weight_b)
    if s.best == b:
        s.best = a


@njit(cache=True)
def merge_all(s: Record) -> None:
    """Replace all hypotheses by the normal distribution with their mean and covariance."""
    for _ in range(s.count - 1):
        merge_pair(s, 0, 1)
        remove_hypothesis(s, 1)


@njit(cache=True)
def limit_soc_std(s: Record, q: int, max_std: float) -> None:
    """Limit the std of the SOC of hypothesis ``q``. Its correlations with the other states remain."""
    covariance = s.covariance[q]
    if covariance[SOC, SOC] > max_std * max_std:
        scale = max_std / math.sqrt(covariance[SOC, SOC])
        covariance[SOC, :] *= scale
        covariance[:, SOC] *= scale


@njit(cache=True)
def remove_hypothesis(s: Record, q: int) -> None:
    """Remove row ``q`` and move the later rows up."""
    for j in range(q, s.count - 1):
        copy_hypothesis(s, j + 1, j)
    s.count -= 1
    clear_hypothesis(s, s.count)
    if s.best > q:
        s.best -= 1


@njit(cache=True)
def mixture_moments(s: Record) -> None:
    """Write mean and std of the mixture's SOC to ``s.soc`` and ``s.soc_std``."""
    total = mean = variance = 0.0
    for q in range(s.count):
        weight = math.exp(s.ln_weight[q] - s.ln_weight[s.best])
        total += weight
        mean += weight * s.mean[q, SOC]
    mean /= total
    for q in range(s.count):
        weight = math.exp(s.ln_weight[q] - s.ln_weight[s.best]) / total
        variance += weight * (s.covariance[q, SOC, SOC] + (s.mean[q, SOC] - mean) ** 2)
    s.soc, s.soc_std = min(max(mean, 0.0), 1.0), math.sqrt(variance)
