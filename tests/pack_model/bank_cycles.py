"""Cycles of a simulated bank: discharges of random steps, rests and full charges."""

from collections.abc import Iterator

import numpy as np

from bms_estimator.model.cell import load_cell
from bms_estimator.simulation.simulated_bank import BankCells, BankHistory, SimulatedBank

CELL = load_cell("ncr18650")
"""True cell."""
ONE_C = CELL.cell.capacity_ah
"""Current of 1 C [A]."""
LOAD_S = 30.0
"""Duration of each load [s]."""
CHARGE_C = 0.4
"""Current of the charger, as a C-rate."""


def new_bank(cells: BankCells) -> SimulatedBank:
    """Return a bank whose charger ends at 4.2 V a cell and whose load is disconnected at 2.8 V a cell."""
    series = cells.soc.size
    return SimulatedBank(CELL, cells, full_v=4.2 * series, cutoff_v=2.8 * series)


def cycle(bank: SimulatedBank, rng: np.random.Generator, step_s: float) -> Iterator[tuple[bool, BankHistory]]:
    """Yield a discharge to SOC 0 to 0.3 at 10 to 32 C, a rest, a full charge and a rest; True: discharge."""
    room_c = rng.uniform(10.0, 32.0)
    steps = int(3600 * rng.uniform(1.5, 4.0) / LOAD_S)
    load = rng.gamma(1.5, 1.0, steps)
    load[rng.random(steps) < 0.15] *= -0.2  # regeneration
    load *= rng.uniform(0.7, 1.0) * ONE_C * 3600.0 / (load.sum() * LOAD_S)
    yield True, bank.run(np.repeat(load, int(LOAD_S / step_s)), step_s, room_c)
    for current_a, hours in ((0.0, rng.uniform(0.3, 2.0)), (-CHARGE_C * ONE_C, 4.0), (0.0, rng.uniform(0.3, 2.0))):
        yield False, bank.run(np.full(int(3600 * hours / step_s), current_a), step_s, room_c)
