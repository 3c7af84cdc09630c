"""Current between two samples."""

from bms_estimator.numba_cache import njit

SLOW_S = 2.0
"""Distance of samples beyond which the current deviates from a straight line [s]."""

GAP_RATIO = 3.0
"""A step is a gap only if it is at least this many times as long as the one before, so that slow sampling does not
count as gaps."""

UNMEASURED_S = 60.0
"""Longest step over which the current counts as measured [s]; for slower sources ``PERIODS`` of their periods."""
PERIODS = 2.5
"""Longest regular step [periods]: a regular source may be late, or lose a sample."""
MAX_FLOW_S = 3600.0
"""A current is not taken to have flowed for longer without a sample: one wrong time stamp must not empty a cell [s]."""


@njit(cache=True)
def interpolated_current(dt_s: float, before_a: float, now_a: float, unmeasured_s: float = UNMEASURED_S) -> float:
    """Return the mean current over a step of ``dt_s``: linear between samples; in a gap only what both ends share [A]."""
    if dt_s <= unmeasured_s:
        return 0.5 * (before_a + now_a)
    if before_a * now_a <= 0.0:
        return 0.0
    return min(before_a, now_a) if now_a > 0.0 else max(before_a, now_a)


@njit(cache=True)
def ramp_correction(change_a: float, taus: float, decay: float) -> float:
    """Return the change of a branch current by a linear ramp between samples, beyond that of its mean [A].

    Args:
        change_a: Change of the current between the samples [A].
        taus: Time between the samples in time constants of the RC pair.
        decay: e^-taus.
    """
    return change_a * (0.5 * (1.0 + decay) - (1.0 - decay) / taus)
