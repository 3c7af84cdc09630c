"""Pack: the cell of Chen and Mora under a load of pulses, rests and charging, independent of the service."""

import random
from collections.abc import Iterator

from bms_estimator.model.cell import load_cell
from bms_estimator.simulation.simulated_pack import SimulatedPack

CELL = load_cell("chen_mora")
CAPACITY_AH = CELL.cell.capacity_ah
MIN_STEP_S, MAX_STEP_S = 20, 400
"""Range of the duration of a load step [s]."""
RATES_C = (0.0, 0.0, 0.2, 0.5, 1.0, 2.0, 3.0, -0.3, -1.0)
"""Load levels [C-rate], to be multiplied by the world's factor; 0 twice, so that rests are more frequent."""
LOAD_FACTORS = (0.1, 0.1, 0.2, 1.0)
"""Factors of the load of a world. Most are small, because a checkpoint is written after each 0.2 % of charge."""


def load_steps(dice: random.Random) -> Iterator[tuple[float, float]]:
    """Yield duration [s] and current [A], positive on discharge. Durations are whole seconds, like the windows of a board."""
    factor = dice.choice(LOAD_FACTORS)
    while True:
        yield float(dice.randint(MIN_STEP_S, MAX_STEP_S)), CAPACITY_AH * factor * dice.choice(RATES_C)


def new_pack(dice: random.Random) -> SimulatedPack:
    """Return a pack at rest with a random SOC of 0.2 to 0.95."""
    return SimulatedPack(CELL, load_steps(dice), soc=dice.uniform(0.2, 0.95))
