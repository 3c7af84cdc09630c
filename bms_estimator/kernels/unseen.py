"""Charge that moved while nobody measured: in a gap of the samples, or between two runs of the service.

``s`` is a record of EKF_STATE, ``p`` of EKF_SETTINGS.
"""

import math

from numba import njit

from bms_estimator.kernels.state import Record

LOAD_S = 600.0
"""The present load is judged over so long; it goes on for about as long [s]."""
USUAL_S = 6.0 * 3600.0
"""What a load is when it has changed is judged over so long [s]."""
IDLE_C = 0.1
"""Std of a current that nobody measured is no less, whatever was seen [C]."""


@njit(cache=True)
def first_load(s: Record, p: Record, current_a: float) -> None:
    """Before a load is seen: what ``switch_on`` takes one to be."""
    one_c = p.capacity_as / 3600.0
    s.mean_a, s.rms_a2 = current_a, max(current_a * current_a, (p.load_mean_c * one_c) ** 2)
    s.usual_a = p.load_mean_c * one_c
    s.usual_a2 = (p.load_mean_c**2 + p.load_level_c**2 + p.load_c**2) * one_c * one_c


@njit(cache=True)
def watch_load(s: Record, current_a: float, dt_s: float) -> None:
    """Mean and mean square of a current of ``current_a`` over ``dt_s`` into the present and the usual load."""
    share = min(1.0, dt_s / LOAD_S)
    s.mean_a += share * (current_a - s.mean_a)
    s.rms_a2 += share * (current_a * current_a - s.rms_a2)
    share = min(1.0, dt_s / USUAL_S)
    s.usual_a += share * (current_a - s.usual_a)
    s.usual_a2 += share * (current_a * current_a - s.usual_a2)


@njit(cache=True)
def goes_on(s: Record, held_a: float, dt_s: float) -> float:
    """Charge that the present load moves in a gap of ``dt_s`` beyond ``held_a``, which both ends agree on, until it changes [A s]."""
    return (s.mean_a - held_a) * LOAD_S * (1.0 - math.exp(-dt_s / LOAD_S))


@njit(cache=True)
def unseen_charge(s: Record, p: Record, held_a: float, dt_s: float) -> float:
    """Std of the charge that moved in ``dt_s`` beside ``held_a`` x ``dt_s`` [A s].

    The current was one of the present load, and after a time of the usual one, at random and the same all the time.
    """
    same = math.exp(-dt_s / LOAD_S)
    present_a2 = s.rms_a2 - 2.0 * held_a * s.mean_a + held_a * held_a
    usual_a2 = s.usual_a2 - 2.0 * held_a * s.usual_a + held_a * held_a
    idle_a = IDLE_C * p.capacity_as / 3600.0
    return math.sqrt(max(same * present_a2 + (1.0 - same) * usual_a2, idle_a * idle_a)) * dt_s
