"""The pack: the cell of Chen and Mora under a load of pulses, rests and charging; it lives on whatever becomes of us."""

import random
from collections.abc import Iterator

from bms_estimator.model.cell import load_cell
from bms_estimator.simulation.simulated_pack import SimulatedPack

CELL = load_cell("chen_mora")
CAPACITY_AH = CELL.cell.capacity_ah
MIN_S, MAX_S = 20, 400
RATES_C = (0.0, 0.0, 0.2, 0.5, 1.0, 2.0, 3.0, -0.3, -1.0)
"""Steps of the load, of its greatest."""
GREATEST = (0.1, 0.1, 0.2, 1.0)
"""A checkpoint is written with each 0.2 % of charge: most packs are under a small load."""


def steps(dice: random.Random) -> Iterator[tuple[float, float]]:
    """Seconds and current [A], positive on discharge; whole seconds, for a board's window knows no more."""
    greatest = dice.choice(GREATEST)
    while True:
        yield float(dice.randint(MIN_S, MAX_S)), CAPACITY_AH * greatest * dice.choice(RATES_C)


def new_pack(dice: random.Random) -> SimulatedPack:
    """A pack somewhere between a fifth and full, at rest."""
    return SimulatedPack(CELL, steps(dice), soc=dice.uniform(0.2, 0.95))
