"""Unmeasured charge: in a gap of the samples, between two runs of the service, or because a source reports little.

``s`` is a record of EKF_STATE, ``p`` of EKF_SETTINGS.
"""

import math

from bms_estimator.kernels.cell_model.current_interpolation import SLOW_S
from bms_estimator.model.arrays import Record
from bms_estimator.numba_cache import njit

LOAD_S = 600.0
"""Averaging time of the present load, and expected duration of that load in a gap [s]."""
USUAL_S = 6.0 * 3600.0
"""Averaging time of the usual load, which follows the present one in a long gap [s]."""
BETWEEN = 0.2
"""Variance of the mean current about that line, over the square of the change: 1/12 where the load stays for much longer than
from one sample to the next, 0.10 and 0.18 with levels of 20 s each 10 s and each 60 s, 1/4 where it is another each time."""
SAME_STEPS = 1.5
"""Maximum difference between two reported currents that count as equal, in steps of the resolution."""
IDLE_C = 0.1
"""Minimum std of an unmeasured current [C]."""


@njit(cache=True)
def initialize_load_statistics(s: Record, p: Record, current_a: float) -> None:
    """Initialize the load statistics before a load is seen, as ``initial_branch_currents`` assumes.

    A small first sample gives more information on the load than a large one, which may be a peak.
    """
    one_c = p.capacity_as / 3600.0
    s.usual_a = p.load_mean_c * one_c
    s.usual_a2 = (p.load_mean_c**2 + p.load_level_c**2 + p.load_c**2) * one_c * one_c
    most_a = math.sqrt(s.usual_a2)
    s.mean_a = min(max(current_a, -most_a), most_a)
    s.rms_a2 = max(s.mean_a * s.mean_a, (p.load_mean_c * one_c) ** 2)


@njit(cache=True)
def update_load_statistics(s: Record, current_a: float, dt_s: float) -> None:
    """Mean and mean square of a current of ``current_a`` over ``dt_s`` into the present and the usual load."""
    share = min(1.0, dt_s / LOAD_S)
    s.mean_a += share * (current_a - s.mean_a)
    s.rms_a2 += share * (current_a * current_a - s.rms_a2)
    share = min(1.0, dt_s / USUAL_S)
    s.usual_a += share * (current_a - s.usual_a)
    s.usual_a2 += share * (current_a * current_a - s.usual_a2)


@njit(cache=True)
def expected_excess_charge(s: Record, held_a: float, dt_s: float) -> float:
    """Charge that the present load moves in a gap of ``dt_s`` beyond ``held_a``, which both ends agree on, until it changes [A s]."""
    return (s.mean_a - held_a) * LOAD_S * (1.0 - math.exp(-dt_s / LOAD_S))


@njit(cache=True)
def gap_charge_std(s: Record, p: Record, held_a: float, dt_s: float) -> float:
    """Std of the charge that moved in ``dt_s`` beside ``held_a`` x ``dt_s`` [A s].

    The current was one of the present load, and after a time of the usual one, at random and the same all the time.
    """
    same = math.exp(-dt_s / LOAD_S)
    present_a2 = s.rms_a2 - 2.0 * held_a * s.mean_a + held_a * held_a
    usual_a2 = s.usual_a2 - 2.0 * held_a * s.usual_a + held_a * held_a
    idle_a = IDLE_C * p.capacity_as / 3600.0
    return math.sqrt(max(same * present_a2 + (1.0 - same) * usual_a2, idle_a * idle_a)) * dt_s


@njit(cache=True)
def interpolation_charge_variance(change_a: float, dt_s: float) -> float:
    """Variance of the charge that moved in ``dt_s`` beside the straight line between two samples [A^2 s^2].

    Args:
        change_a: Change of the current between the two [A].
        dt_s: Time between the samples [s].
    """
    return BETWEEN * (change_a * dt_s) ** 2 if dt_s > SLOW_S else 0.0


@njit(cache=True)
def rounding_charge_variance(s: Record, p: Record, dt_s: float, current_a: float) -> float:
    """Return the additional variance of the charge within ``dt_s`` by the steps of the current [A^2 s^2].

    While the reported current stays the same, the error stays the same: its charge has the variance (error x time)^2.
    """
    error_a2 = p.current_step_a * p.current_step_a / 12.0  # of rounding
    if current_a == 0.0 and s.current_a == 0.0:
        error_a2 = max(error_a2, p.dead_band_a * p.dead_band_a / 3.0)  # anything within
    same = abs(current_a - s.current_a) <= SAME_STEPS * p.current_step_a
    before_s = s.same_s if same else 0.0
    s.same_s = before_s + dt_s
    return error_a2 * (s.same_s * s.same_s - before_s * before_s)
