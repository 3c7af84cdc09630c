"""Random numbers of the draws: splitmix64 (Steele, Lea and Flood, OOPSLA 2014), whose state is one integer.

Each draw has its own generator, so that it can be repeated alone. The constants are those of splitmix64.
"""

import math

import numpy as np

from bms_estimator.numba_cache import njit

_INCREMENT = np.uint64(0x9E3779B97F4A7C15)
_FIRST_FACTOR = np.uint64(0xBF58476D1CE4E5B9)
_SECOND_FACTOR = np.uint64(0x94D049BB133111EB)
_SHIFTS = np.uint64(30), np.uint64(27), np.uint64(31)
_SHIFT_TO_53_BITS = np.uint64(11)
_UNIT_OF_53_BITS = 2.0**-53


@njit(cache=True)
def mix(state: np.uint64) -> np.uint64:
    """Return the random integer of a generator state."""
    z = (state ^ (state >> _SHIFTS[0])) * _FIRST_FACTOR
    z = (z ^ (z >> _SHIFTS[1])) * _SECOND_FACTOR
    return z ^ (z >> _SHIFTS[2])


@njit(cache=True)
def generator_of_draw(seed: np.uint64, draw: int) -> np.uint64:
    """Return the initial state of the generator of one draw."""
    return mix(seed + np.uint64(draw) * _INCREMENT)


@njit(cache=True)
def uniform(state: np.uint64) -> tuple[np.uint64, float]:
    """Return the next state, and a random number above 0 and below 1."""
    state += _INCREMENT
    return state, (float(mix(state) >> _SHIFT_TO_53_BITS) + 0.5) * _UNIT_OF_53_BITS


@njit(cache=True)
def normal(state: np.uint64) -> tuple[np.uint64, float]:
    """Return the next state, and a random number of the standard normal distribution (Box and Muller)."""
    state, first = uniform(state)
    state, second = uniform(state)
    return state, math.sqrt(-2.0 * math.log(first)) * math.cos(2.0 * math.pi * second)


@njit(cache=True)
def student_t(state: np.uint64, degrees: float) -> tuple[np.uint64, float]:
    """Return the next state, and a random number of Student's t distribution (Bailey, Mathematics of Computation 1994)."""
    state, first = uniform(state)
    state, second = uniform(state)
    return state, math.sqrt(degrees * math.expm1(-2.0 / degrees * math.log(first))) * math.cos(2.0 * math.pi * second)
