"""Simulated 4S LFP pack with a charger, a load and a protection circuit."""

import math
from enum import Enum

import numpy as np

from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.chen_mora import cell_step, ocv, r_s
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.cell_sections import ELEMENTS
from bms_estimator.simulation.virtual_adc import Reading

SERIES = 4
RATED_AH = 2.0
"""Capacity on the label [Ah]. The true capacity is ``CAPACITY_FACTOR`` times as large."""
CAPACITY_FACTOR, OHM_FACTOR, OCV_SHIFT_V = 0.92, 1.3, 0.006
"""Differences of the true cell from the generic one: factors, and the shift of the OCV in the middle of SOC [V]."""
FULL_V = 14.4
"""Voltage at which the charger limits its current [V]."""
CHARGER_END_A = 0.08
"""Current at which the charge ends [A]."""
HYSTERESIS_V, HYSTERESIS_SOC = 0.008, 0.03
"""Difference between the OCVs of a cell after a charge and after a discharge [V], and the SOC over which one changes to the other."""
PROTECTION_V = 8.8
"""Voltage at which the protection circuit disconnects the load [V]."""
ROOM_C = 25.0


class Connected(Enum):
    """Connection of the pack's terminals."""

    NOTHING = "nothing"
    CHARGER = "charger"
    LOAD = "load"


def true_cell() -> CellModel:
    """Return one cell of the pack, which differs from the generic cell."""
    table = load_cell("lfp", RATED_AH).model_dump() | {"ladder": None}
    for name in ("r_ts", "r_tl", "r_s"):
        for key in ELEMENTS[name][1:]:
            table[name][key] *= OHM_FACTOR
    soc = np.array(table["ocv"]["soc"])
    table["ocv"]["ocv_v"] = tuple(np.array(table["ocv"]["ocv_v"]) + OCV_SHIFT_V * np.sin(math.pi * soc))
    table["cell"]["capacity_ah"] *= CAPACITY_FACTOR
    return CellModel.model_validate(table)


class LfpPack:
    """Simulated pack, at rest at time 0. Call the object with times that never decrease.

    Args:
        soc: SOC at time 0.
        charger_a: Maximum current of the charger [A].

    Attributes:
        connected: Device that a user has connected.
        load_a: Current of the load [A].
        history: Time [s] and true SOC (0..1) of each call.
    """

    def __init__(self, soc: float, charger_a: float) -> None:
        self._charger_a = charger_a
        cell = true_cell().pack(SERIES, 1)
        self._a, self._capacity_as, self._ocv = cell.a, 3600.0 * cell.cell.capacity_ah, ocv_grid(cell)
        self._state, self._time_s, self._current_a = (soc, 0.0, 0.0), 0.0, 0.0
        self._hysteresis = 0.0  # -1 after a discharge, 1 after a charge
        self._has_charger_ended = self._is_protected = False
        self.connected, self.load_a = Connected.NOTHING, 0.0
        self.history: list[tuple[float, float]] = []

    def connect(self, what: Connected, load_a: float = 0.0) -> None:
        """Connect the charger, a load or nothing."""
        if what is not self.connected:
            self._has_charger_ended = self._is_protected = False
        self.connected, self.load_a = what, load_a

    @property
    def soc(self) -> float:
        """True SOC: 0 and 1 are the ends of the OCV curve."""
        return self._state[0]

    @property
    def is_charged(self) -> bool:
        """True if the charger is connected and has ended."""
        return self._has_charger_ended

    @property
    def voltage_v(self) -> float:
        """Voltage at the terminals [V]."""
        return self._voltage_behind_r_s - self._current_a * r_s(self.soc, self._a)

    def __call__(self, time_s: float) -> Reading:
        """Return the reading at a time [s]."""
        step_s = time_s - self._time_s
        self._state = cell_step(self._state, self._current_a, step_s, self._capacity_as, self._a)
        charged_soc = -self._current_a * step_s / self._capacity_as
        change = 1.0 - math.exp(-abs(charged_soc) / HYSTERESIS_SOC)
        self._hysteresis += change * (math.copysign(1.0, charged_soc) - self._hysteresis)
        self._time_s, self._current_a = time_s, self._next_current()
        self.history.append((time_s, self.soc))
        return Reading(self._current_a, self.voltage_v, ROOM_C)

    @property
    def _voltage_behind_r_s(self) -> float:
        """Voltage without the drop at the series resistance [V]."""
        soc, v_ts, v_tl = self._state
        hysteresis_v = 0.5 * HYSTERESIS_V * SERIES * self._hysteresis
        return float(ocv(soc, *self._ocv) + hysteresis_v - v_ts - v_tl)

    def _next_current(self) -> float:
        """Return the current, positive on discharge [A]."""
        if self.connected is Connected.CHARGER and not self._has_charger_ended:
            limited_a = (FULL_V - self._voltage_behind_r_s) / r_s(self.soc, self._a)
            self._has_charger_ended = limited_a <= CHARGER_END_A
            return 0.0 if self._has_charger_ended else -min(limited_a, self._charger_a)
        if self.connected is Connected.LOAD and not self._is_protected:
            self._is_protected = self._voltage_behind_r_s - self.load_a * r_s(self.soc, self._a) < PROTECTION_V
            return 0.0 if self._is_protected else self.load_a
        return 0.0
