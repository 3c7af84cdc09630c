"""Draws (Monte Carlo samples) of pack and load, and their random numbers.

The generator is splitmix64 (Steele, Lea and Flood, OOPSLA 2014), whose state is one integer, with its constants. Each draw has its
own generator, so that it can be repeated alone.

``d`` is a record of DRAW, ``m`` of PROJECTED_PACK.
"""

import math

import numpy as np

from bms_estimator.kernels.cell_model.rc_ladder import BRANCHES
from bms_estimator.kernels.forecast.projected_pack import voltage_without_load
from bms_estimator.model.arrays import Record, Records
from bms_estimator.numba_cache import njit

_INCREMENT = np.uint64(0x9E3779B97F4A7C15)
_FIRST_FACTOR = np.uint64(0xBF58476D1CE4E5B9)
_SECOND_FACTOR = np.uint64(0x94D049BB133111EB)
_SHIFTS = np.uint64(30), np.uint64(27), np.uint64(31)
_SHIFT_TO_53_BITS = np.uint64(11)
_UNIT_OF_53_BITS = 2.0**-53
MAX_LOAD_FACTOR = 10.0
"""Maximum factor on the load, and the inverse of the minimum. It limits the long tails of Student's t distribution."""

DRAW = np.dtype(
    [
        ("begin_soc", "f8"),  # SOC of the weakest cell at the beginning
        ("capacity_as", "f8"),  # capacity of the weakest cell [A s]
        ("load_factor", "f8"),  # factor on the load
        ("voltage_error_v", "f8"),  # error of the modeled voltage [V]
        ("resistance_factor", "f8"),  # factor on the voltage drop
        ("first_generator", "u8"),  # state of the random generator after pack and load factor were drawn
        ("generator", "u8"),  # present state of the random generator
        ("block", "i8"),  # index of the present block of the load
        ("run", "i8"),  # number of blocks until the next jump to a random block
        ("difference_a", "f8", BRANCHES),  # RC currents minus those with which the present block was tabulated [A]
        ("first_pair", "i8"),  # index of the first RC pair with a difference that is not negligible
        ("ended", "i8"),  # 1: the cut-off came within the horizon
        ("time_s", "f8"),  # time until the cut-off or the horizon [s]
        ("soc", "f8"),  # SOC at that time
    ],
    align=True,
)
"""Pack, load and outcome of one draw."""


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


@njit(cache=True)
def draw_packs(m: Record, seed: np.uint64, draws: Records) -> None:
    """Draw the pack of each draw. The factor on the load is 1.

    Args:
        m: Record of PROJECTED_PACK.
        seed: Seed of the random numbers.
        draws: Shape (n,), dtype DRAW; written.
    """
    for n in range(draws.shape[0]):
        draw_pack(draws[n], m, generator_of_draw(seed, n))


@njit(cache=True)
def draw_pack(d: Record, m: Record, generator: np.uint64) -> None:
    """Draw the pack of one draw from its generator."""
    generator, soc_stds = normal(generator)
    generator, capacity_stds = normal(generator)
    generator, voltage_stds = normal(generator)
    generator, resistance_stds = normal(generator)
    generator, weakest_stds = normal(generator)
    imbalance = m.weakest_std * max(weakest_stds, 0.0)  # the weakest cell is never better than the mean
    d.begin_soc = m.soc - m.surface_soc + m.soc_std * soc_stds
    d.begin_soc -= imbalance * max(1.0 - d.begin_soc, 0.0)
    d.capacity_as = m.capacity_as * math.exp(m.capacity_std * capacity_stds) / (1.0 + imbalance)
    d.load_factor = 1.0
    d.voltage_error_v = m.voltage_std_v * voltage_stds
    d.resistance_factor = m.resistance_mean + m.resistance_std * resistance_stds
    d.first_generator = generator


@njit(cache=True)
def draw_load_factors(std: float, degrees: float, draws: Records) -> None:
    """Draw the factor on the load of each draw.

    Args:
        std: Scale of Student's t distribution of ln factor.
        degrees: Degrees of freedom of this distribution, above 0.
        draws: Shape (n,), dtype DRAW, by ``draw_packs``; written.
    """
    limit = math.log(MAX_LOAD_FACTOR)
    for n in range(draws.shape[0]):
        d = draws[n]
        d.first_generator, stds = student_t(d.first_generator, degrees)
        d.load_factor = math.exp(min(max(std * stds, -limit), limit))


@njit(cache=True)
def loaded_voltage(d: Record, m: Record, soc: float, drop_v: float) -> float:
    """Return the terminal voltage at ``soc`` for the model's voltage drop ``drop_v`` [V]."""
    return voltage_without_load(m, soc) + m.bias_v + d.voltage_error_v - d.resistance_factor * drop_v
