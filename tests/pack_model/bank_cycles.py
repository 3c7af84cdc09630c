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
MAX_PAUSE_S = 3600.0
"""Maximum duration of the pause in a discharge [s]."""
CHARGE_C = 0.4
"""Current of the charger, as a C-rate."""


def new_bank(cells: BankCells) -> SimulatedBank:
    """Return a bank whose charger ends at 4.2 V a cell and whose load is disconnected at 2.8 V a cell."""
    series = cells.soc.size
    return SimulatedBank(CELL, cells, full_v=4.2 * series, cutoff_v=2.8 * series)


def cycle(
    bank: SimulatedBank,
    rng: np.random.Generator,
    step_s: float,
    *,
    one_c: float = ONE_C,
    room_c: float | None = None,
    charge_h: float = 4.0,
) -> Iterator[tuple[bool, BankHistory]]:
    """Yield a discharge with a pause to SOC 0 to 0.3, a rest, a charge and a rest; True: discharge.

    Args:
        bank: Simulated bank.
        rng: Random generator.
        step_s: Interval between two times [s].
        one_c: Current of 1 C [A].
        room_c: Temperature [degC]; None: random, 10 to 32 C.
        charge_h: Maximum duration of the charge [h]. A full charge takes less than 4 h.
    """
    celsius = rng.uniform(10.0, 32.0) if room_c is None else room_c
    steps = int(3600 * rng.uniform(1.5, 4.0) / LOAD_S)
    load = rng.gamma(1.5, 1.0, steps)
    load[rng.random(steps) < 0.15] *= -0.2  # regeneration
    load = np.insert(load, rng.integers(steps), np.zeros(int(rng.uniform(0.0, MAX_PAUSE_S) / LOAD_S)))
    load *= rng.uniform(0.7, 1.0) * one_c * 3600.0 / (load.sum() * LOAD_S)
    yield True, bank.run(np.repeat(load, int(LOAD_S / step_s)), step_s, celsius)
    for current_a, hours in ((0.0, rng.uniform(0.3, 2.0)), (-CHARGE_C * one_c, charge_h), (0.0, rng.uniform(0.3, 2.0))):
        yield False, bank.run(np.full(int(3600 * hours / step_s), current_a), step_s, celsius)
