"""Simulated pack under an endless load, with the cell model of Chen and Mora, (2.1) to (2.4) of the thesis."""

import math
import random
from collections.abc import Callable, Iterator
from enum import StrEnum

from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.chen_mora import cell_step, ocv, r_s
from bms_estimator.model.cell import CellModel
from bms_estimator.simulation.virtual_adc import Reading

EMPTY_SOC = 0.05
"""SOC at which the load stops and the pack is charged."""
FULL_SOC = 0.95
"""SOC up to which the pack is charged. Above this SOC the load does not charge it."""
ROOM_C = 25.0
"""Temperature of the pack [degC]."""
PULSE_S = 10.0
"""Duration of a pulse, and of the pause after it [s]."""
MIN_STEP_S, MAX_STEP_S = 1.0, 5.0
"""Range of the duration of a random step [s]."""
MAX_CHARGE_FRACTION = 0.25
"""Maximum charging current of random steps, as a fraction of the load current."""

Load = Iterator[tuple[float, float]]
"""Endless sequence of duration [s] and current [A], positive on discharge."""


def constant(current_a: float, _seed: int = 0) -> Load:
    """Yield a constant current."""
    while True:
        yield math.inf, current_a


def pulses(current_a: float, _seed: int = 0) -> Load:
    """Yield alternately ``PULSE_S`` of the current and of no current."""
    while True:
        yield PULSE_S, current_a
        yield PULSE_S, 0.0


def random_steps(current_a: float, seed: int = 0) -> Load:
    """Yield steps of random duration and current; some of them charge."""
    rng = random.Random(seed)
    while True:
        yield rng.uniform(MIN_STEP_S, MAX_STEP_S), current_a * rng.uniform(-MAX_CHARGE_FRACTION, 1.0)


class LoadName(StrEnum):
    """Kinds of load."""

    CONSTANT = "constant"
    PULSE = "pulse"
    RANDOM = "random"
    RELAY = "relay"
    """Load that the relay of a board connects, see ``PackWithRelay``."""


LOADS: dict[LoadName, Callable[[float, int], Load]] = {
    LoadName.CONSTANT: constant,
    LoadName.PULSE: pulses,
    LoadName.RANDOM: random_steps,
}
"""Function that creates a load from its current [A] and a seed."""


class SimulatedPack:
    """Simulated pack. Call the object with times that never decrease.

    An empty pack is charged; a full one is not charged further.

    Args:
        cell: Cell model of the whole pack.
        load: Load profile.
        soc: SOC at time 0, 0..1, at which the pack is at rest.
    """

    def __init__(self, cell: CellModel, load: Load, *, soc: float = 0.9) -> None:
        self._a, self._capacity_as = cell.a, cell.cell.capacity_ah * 3600.0
        self._ocv = ocv_grid(cell)
        self._charge_a = -cell.cell.capacity_ah  # 1C; charging is negative
        self._load = load
        self._remaining_s, self._load_a = next(load)
        self._charging = False
        self._state = (soc, 0.0, 0.0)
        self._current_a = self._load_a
        self.time_s = 0.0
        """Time of the last reading [s]."""

    @property
    def soc(self) -> float:
        """True SOC, 0..1."""
        return self._state[0]

    def __call__(self, time_s: float) -> Reading:
        """Return voltage and current at the pack's terminals at ``time_s`` [s]."""
        dt_s, self.time_s = time_s - self.time_s, time_s
        self._state = cell_step(self._state, self._current_a, dt_s, self._capacity_as, self._a)
        self._current_a = self._next_current(dt_s)
        soc, v_ts, v_tl = self._state
        voltage_v = ocv(soc, *self._ocv) - v_ts - v_tl - self._current_a * r_s(soc, self._a)  # (2.4) of the thesis
        return Reading(self._current_a, float(voltage_v), ROOM_C)

    def _next_current(self, dt_s: float) -> float:
        """Return the current ``dt_s`` later. The load pauses while the pack is charged."""
        # hysteresis: a charge that begins at EMPTY_SOC ends at FULL_SOC
        self._charging = self.soc <= (FULL_SOC if self._charging else EMPTY_SOC)
        if self._charging:
            return self._charge_a
        self._remaining_s -= dt_s
        while self._remaining_s <= 0.0:
            seconds, self._load_a = next(self._load)
            self._remaining_s += seconds
        return max(self._load_a, 0.0) if self.soc >= FULL_SOC else self._load_a


class PackWithRelay(SimulatedPack):
    """Simulated pack whose load is connected by a relay. It is never charged.

    Args:
        cell: Cell model of the whole pack.
        load_a: Current of the load [A].
        soc: SOC at time 0, 0..1, at which the pack is at rest.
    """

    def __init__(self, cell: CellModel, load_a: float, *, soc: float) -> None:
        super().__init__(cell, constant(0.0), soc=soc)
        self._connected_a = load_a
        self.is_connected: Callable[[], bool] = lambda: False
        """Function that returns True while the relay connects the load."""

    def _next_current(self, _dt_s: float) -> float:
        """Return the current of the load while it is connected and the pack is not empty."""
        return self._connected_a if self.is_connected() and self.soc > 0.0 else 0.0
