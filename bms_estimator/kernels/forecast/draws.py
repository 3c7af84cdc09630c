"""Spread of the draws: what each draw assumes of pack and load.

``d`` is a record of DRAW, ``m`` of PROJECTED_PACK.
"""

import math

import numpy as np

from bms_estimator.kernels.cell_model.rc_ladder import BRANCHES
from bms_estimator.kernels.forecast.projected_pack import voltage_without_load
from bms_estimator.kernels.forecast.random_numbers import generator_of_draw, normal
from bms_estimator.model.arrays import Record, Records
from bms_estimator.numba_cache import njit

GROWTH_SOC = 0.4
"""SOC below which the resistances grow."""

DRAW = np.dtype(
    [
        ("begin_soc", "f8"),  # SOC of the weakest cell at the beginning
        ("capacity_as", "f8"),  # of the weakest cell [A s]
        ("load", "f8"),  # factor on the load
        ("voltage_v", "f8"),  # error of the voltage [V]
        ("resistance", "f8"),  # factor on the voltage drop
        ("first_generator", "u8"),  # state of the generator of random numbers after these
        ("generator", "u8"),  # present state of the generator
        ("block", "i8"),  # index of the present block of the load
        ("run", "i8"),  # number of blocks until the next jump to another one
        ("difference_a", "f8", BRANCHES),  # currents of the RC pairs, less those of the present block in the past [A]
        ("slower", "i8"),  # index of the first RC pair that has such a difference
        ("ended", "i8"),  # 1: the cut-off came within the horizon
        ("time_s", "f8"),  # time until the cut-off or the horizon [s]
        ("soc", "f8"),  # SOC at that time
    ],
    align=True,
)
"""Assumptions, present load and outcome of one draw."""


@njit(cache=True)
def draw_packs(m: Record, seed: np.uint64, draws: Records) -> None:
    """Draw pack and load factor of each draw.

    Args:
        m: Record of PROJECTED_PACK.
        seed: Seed of the random numbers.
        draws: Shape (n,), dtype DRAW; written.
    """
    for n in range(draws.shape[0]):
        draw_pack(draws[n], m, generator_of_draw(seed, n))


@njit(cache=True)
def draw_pack(d: Record, m: Record, generator: np.uint64) -> None:
    """Draw pack and load factor of one draw from its generator."""
    generator, of_soc = normal(generator)
    generator, of_capacity = normal(generator)
    generator, of_load = normal(generator)
    generator, of_voltage = normal(generator)
    generator, of_resistance = normal(generator)
    generator, of_weakest = normal(generator)
    weakest = m.weakest_std * max(of_weakest, 0.0)  # the weakest cell is never better than the mean
    d.begin_soc = m.soc - m.early_soc + m.soc_std * of_soc
    d.begin_soc -= weakest * max(1.0 - d.begin_soc, 0.0)
    d.capacity_as = m.capacity_as * math.exp(m.capacity_std * of_capacity) / (1.0 + weakest)
    d.load = math.exp(m.load_std * of_load)
    d.voltage_v = m.voltage_std_v * of_voltage
    d.resistance = m.resistance_mean + m.resistance_std * of_resistance
    d.first_generator = generator


@njit(cache=True)
def lowness(soc: float) -> float:
    """Return 0 above ``GROWTH_SOC``, rising to 1 at SOC 0."""
    return min(max(1.0 - soc / GROWTH_SOC, 0.0), 1.0)


@njit(cache=True)
def drop_factor(d: Record, m: Record, soc: float) -> float:
    """Return the factor on the model's voltage drop at ``soc``. The present resistances contain the growth until now."""
    return d.resistance + m.growth * max(lowness(soc) - lowness(m.soc), 0.0)


@njit(cache=True)
def loaded_voltage(d: Record, m: Record, soc: float, drop_v: float) -> float:
    """Return the terminal voltage at ``soc`` for the model's voltage drop ``drop_v`` [V]."""
    return voltage_without_load(m, soc) + m.bias_v + d.voltage_v - drop_factor(d, m, soc) * drop_v
