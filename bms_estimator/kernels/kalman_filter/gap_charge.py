"""Charge that was not measured, and its std: in gaps, between runs of the service, and between slow or rounded samples.

``s`` is a record of EKF_STATE, ``p`` of EKF_SETTINGS.
"""

import math

from bms_estimator.kernels.cell_model.current_interpolation import RAMP_STEP_S
from bms_estimator.model.arrays import Record
from bms_estimator.numba_cache import njit

PRESENT_LOAD_S = 600.0
"""Averaging time of the present load, and expected duration of that load in a gap [s]."""
LONG_TERM_S = 6.0 * 3600.0
"""Averaging time of the long-term mean load, which is expected after the present one in a long gap [s]."""
INTERPOLATION_VARIANCE = 0.2
"""Variance of the mean current between two samples by linear interpolation, divided by the squared change of the current
between the samples. It is 1/12 for loads that last much longer than a sample period, 0.10 and 0.18 for loads of 20 s sampled
every 10 s and every 60 s, and 1/4 for independent samples."""
SKEW_VARIANCE = 2.0
"""Variance of the current between two samples about the straight line, divided by f (1 - f) and by the squared change of the
current between the samples. f is the fraction of the time that has passed. The ratio is 1 for one step at a random time, and 3
for independent values. In the middle between samples 10 s and 60 s apart, a load whose levels last 20 s has 1.2 and 2.2."""
MAX_EQUAL_STEPS = 1.5
"""Maximum difference between two reported currents that count as equal, in steps of the resolution."""
MIN_UNMEASURED_STD_C = 0.1
"""Minimum std of an unmeasured current, as a C-rate: a multiple of the current that empties the cell in an hour."""
RESTING_C = 0.1
"""Maximum mean current over 10 min of a resting pack, as a C-rate."""


@njit(cache=True)
def initialize_load_statistics(s: Record, p: Record, current_a: float) -> None:
    """Initialize the load statistics at the first sample with the prior of the load before switch-on.

    That load is the sum of its mean ``load_mean_c``, a part with std ``load_level_c`` that is constant for hours, and a
    varying part with std ``load_c``, all as C-rates. ``s.rms_a2`` is the mean square over 10 min, not its root. The mean of
    the present load is the first sample's current, limited because a large current may be a short peak.
    """
    one_c = p.capacity_as / 3600.0
    s.usual_a = p.load_mean_c * one_c
    s.usual_a2 = (p.load_mean_c**2 + p.load_level_c**2 + p.load_c**2) * one_c * one_c
    limit_a = math.sqrt(s.usual_a2)
    s.mean_a = min(max(current_a, -limit_a), limit_a)
    s.rms_a2 = max(s.mean_a * s.mean_a, (p.load_mean_c * one_c) ** 2)


@njit(cache=True)
def update_load_statistics(s: Record, current_a: float, dt_s: float) -> None:
    """Update mean and mean square of the present and the long-term load by ``current_a`` over ``dt_s``."""
    share = min(1.0, dt_s / PRESENT_LOAD_S)
    s.mean_a += share * (current_a - s.mean_a)
    s.rms_a2 += share * (current_a * current_a - s.rms_a2)
    share = min(1.0, dt_s / LONG_TERM_S)
    s.usual_a += share * (current_a - s.usual_a)
    s.usual_a2 += share * (current_a * current_a - s.usual_a2)


@njit(cache=True)
def expected_excess_charge(s: Record, held_a: float, dt_s: float) -> float:
    """Return the expected charge in a gap of ``dt_s`` beyond ``held_a`` x ``dt_s`` [A s].

    The present load is expected to end at random with the mean duration ``PRESENT_LOAD_S``.

    Args:
        s: Record of EKF_STATE.
        held_a: Current that the caller counts over the gap [A].
        dt_s: Duration of the gap [s].
    """
    return (s.mean_a - held_a) * PRESENT_LOAD_S * (1.0 - math.exp(-dt_s / PRESENT_LOAD_S))


@njit(cache=True)
def gap_charge_std(s: Record, p: Record, held_a: float, dt_s: float) -> float:
    """Return the std of the charge in ``dt_s`` about ``held_a`` x ``dt_s`` [A s].

    The unknown current is assumed constant over the gap. Its distribution changes from the present load in a short gap to
    the long-term load in a long gap.
    """
    present_share = math.exp(-dt_s / PRESENT_LOAD_S)
    present_a2 = s.rms_a2 - 2.0 * held_a * s.mean_a + held_a * held_a
    usual_a2 = s.usual_a2 - 2.0 * held_a * s.usual_a + held_a * held_a
    min_std_a = MIN_UNMEASURED_STD_C * p.capacity_as / 3600.0
    mean_a2 = present_share * present_a2 + (1.0 - present_share) * usual_a2
    return math.sqrt(max(mean_a2, min_std_a * min_std_a)) * dt_s


@njit(cache=True)
def is_resting(s: Record, p: Record) -> bool:
    """Return True if the pack rests: its mean current over 10 min is small."""
    return abs(s.mean_a) < RESTING_C * p.capacity_as / 3600.0


@njit(cache=True)
def interpolation_charge_variance(change_a: float, dt_s: float) -> float:
    """Return the variance of the charge in ``dt_s`` about the straight line between two samples [A^2 s^2].

    Args:
        change_a: Change of the current between the samples [A].
        dt_s: Time between the samples [s].
    """
    return INTERPOLATION_VARIANCE * (change_a * dt_s) ** 2 if dt_s > RAMP_STEP_S else 0.0


@njit(cache=True)
def rounding_charge_variance(s: Record, p: Record, dt_s: float, current_a: float) -> float:
    """Advance the time of equal currents ``s.same_s``, and return the variance that ``dt_s`` adds to the charge [A^2 s^2].

    The variance is due to the resolution of the current. A constant reported current has a constant error, so that the
    variance of its charge grows with the square of the time.
    """
    error_a2 = p.current_step_a * p.current_step_a / 12.0  # variance of rounding
    if current_a == 0.0 and s.current_a == 0.0:
        error_a2 = max(error_a2, p.dead_band_a * p.dead_band_a / 3.0)  # uniform within the dead band
    is_equal = abs(current_a - s.current_a) <= MAX_EQUAL_STEPS * p.current_step_a
    previous_s = s.same_s if is_equal else 0.0
    s.same_s = previous_s + dt_s
    return error_a2 * (s.same_s * s.same_s - previous_s * previous_s)
