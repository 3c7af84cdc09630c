"""A simulated pack under a load: what a simulated board has at its sensors.

The cell of Chen and Mora (2.1)-(2.4) under a load that never ends: an empty pack is charged, a full one is not.
"""

import math
import random
from collections.abc import Callable, Iterator
from enum import StrEnum

from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.chen_mora import cell_step, ocv, r_s
from bms_estimator.model.cell import CellModel
from bms_estimator.simulation.virtual_adc import Reading

EMPTY_SOC, FULL_SOC = 0.05, 0.95
"""The load stops at the one and begins again at the other; in between the pack is charged. Above the other no load charges it."""
ROOM_C = 25.0
PULSE_S = 10.0
MIN_STEP_S, MAX_STEP_S = 1.0, 5.0
MAX_CHARGE = 0.25
"""Random steps also charge, with up to this part of the current."""

Load = Iterator[tuple[float, float]]
"""Seconds, current [A], positive on discharge; endless."""


def constant(current_a: float, _seed: int = 0) -> Load:
    """One current."""
    while True:
        yield math.inf, current_a


def pulses(current_a: float, _seed: int = 0) -> Load:
    """On and off, ``PULSE_S`` each."""
    while True:
        yield PULSE_S, current_a
        yield PULSE_S, 0.0


def random_steps(current_a: float, seed: int = 0) -> Load:
    """Return a schedule of steps of random length and height, some of them charging."""
    dice = random.Random(seed)
    while True:
        yield dice.uniform(MIN_STEP_S, MAX_STEP_S), current_a * dice.uniform(-MAX_CHARGE, 1.0)


class LoadName(StrEnum):
    """Kinds of load."""

    CONSTANT = "constant"
    PULSE = "pulse"
    RANDOM = "random"


LOADS: dict[LoadName, Callable[[float, int], Load]] = {
    LoadName.CONSTANT: constant,
    LoadName.PULSE: pulses,
    LoadName.RANDOM: random_steps,
}
"""Loads by name, made from the current [A] and a seed."""


class SimulatedPack:
    """Signal of a board: call it with times that never step back.

    Args:
        cell: The pack as one object.
        load: Load profile.
        soc: At time 0, 0..1; the pack is at rest then.
    """

    def __init__(self, cell: CellModel, load: Load, *, soc: float = 0.9) -> None:
        self._a, self._capacity_as = cell.a, cell.cell.capacity_ah * 3600.0
        self._ocv = ocv_grid(cell)
        self._charge_a = -cell.cell.capacity_ah  # 1C
        self._load = load
        self._left_s, self._load_a = next(load)
        self._charging = False
        self._state = (soc, 0.0, 0.0)
        self._current_a = self._load_a
        self.time_s = 0.0
        """Time of the last reading [s]."""

    @property
    def soc(self) -> float:
        """The truth, 0..1."""
        return self._state[0]

    def __call__(self, time_s: float) -> Reading:
        """Return voltage and current at the pack's terminals at ``time_s`` [s]."""
        dt_s, self.time_s = time_s - self.time_s, time_s
        self._state = cell_step(self._state, self._current_a, dt_s, self._capacity_as, self._a)
        self._current_a = self._next_current(dt_s)
        soc, v_ts, v_tl = self._state
        voltage_v = ocv(soc, *self._ocv) - v_ts - v_tl - self._current_a * r_s(soc, self._a)  # (2.4)
        return Reading(self._current_a, float(voltage_v), ROOM_C)

    def _next_current(self, dt_s: float) -> float:
        """Return the current of the load ``dt_s`` later; charging stops its time."""
        self._charging = self.soc <= (FULL_SOC if self._charging else EMPTY_SOC)
        if self._charging:
            return self._charge_a
        self._left_s -= dt_s
        while self._left_s <= 0.0:
            seconds, self._load_a = next(self._load)
            self._left_s += seconds
        return max(self._load_a, 0.0) if self.soc >= FULL_SOC else self._load_a
