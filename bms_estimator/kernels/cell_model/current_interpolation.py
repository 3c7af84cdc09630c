"""Current between two samples."""

from bms_estimator.model.unmeasured_time import UNMEASURED_S
from bms_estimator.numba_cache import njit

RAMP_STEP_S = 2.0
"""Interval between samples above which the current counts as a ramp, and its charge as uncertain [s]. The current may
deviate from a straight line between the samples."""
GAP_RATIO = 3.0
"""Minimum ratio of a gap to the previous step, so that slow sampling does not count as gaps."""
MAX_STEP_PERIODS = 2.5
"""Maximum regular step in multiples of the sample period. A regular source may be late or lose a sample."""


@njit(cache=True)
def interpolated_current(dt_s: float, before_a: float, now_a: float, unmeasured_s: float = UNMEASURED_S) -> float:
    """Return the mean current over a step of ``dt_s`` [A].

    The current is linear between samples. Over a step above ``unmeasured_s`` it is the end of smaller magnitude, or 0 if the
    signs of the ends differ.
    """
    if dt_s <= unmeasured_s:
        return 0.5 * (before_a + now_a)
    if before_a * now_a <= 0.0:
        return 0.0
    return min(before_a, now_a) if now_a > 0.0 else max(before_a, now_a)


@njit(cache=True)
def ramp_correction(change_a: float, taus: float, decay: float) -> float:
    """Return the correction for a ramp of the current through the resistor of an RC pair at the end of a step [A].

    The correction is the difference between the current for a linear ramp and the current for the constant mean of the ramp.

    Args:
        change_a: Change of the current between the samples [A].
        taus: Time between the samples in multiples of the RC pair's time constant.
        decay: e^-taus.
    """
    return change_a * (0.5 * (1.0 + decay) - (1.0 - decay) / taus)
