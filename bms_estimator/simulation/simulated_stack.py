"""Simulated fuel cell stack under an endless load."""

import numpy as np

from bms_estimator.kernels.cell_model.fuel_cell import advance, load_file_constants, output, steady_state
from bms_estimator.kernels.observer.learning_records import LEARNABLE
from bms_estimator.model.pack_model import FuelCellModel
from bms_estimator.simulation.simulated_pack import Load
from bms_estimator.simulation.virtual_adc import Reading


class SimulatedStack:
    """Simulated stack at the temperature of its file. Call the object with times that never decrease.

    A stack cannot be charged, so that negative currents of the load count as 0.

    Args:
        stack: Model of the stack.
        load: Load profile; the stack begins in its steady state under the first current.
    """

    def __init__(self, stack: FuelCellModel, load: Load) -> None:
        self._load, self._temperature_c = load, stack.fuel_cell.temperature_c
        self._remaining_s, load_a = next(load)
        self._current_a, self._time_s = max(load_a, 0.0), 0.0
        self._theta, self._file_constants = np.zeros(LEARNABLE), np.zeros(LEARNABLE)
        # the kernels also compute the derivatives by theta, which are not used
        self._x, self._dx, self._psi = np.zeros(2), np.zeros((2, LEARNABLE)), np.zeros(LEARNABLE)
        load_file_constants(self._file_constants, stack.a, self._temperature_c)
        steady_state(self._x, self._dx, self._theta, self._file_constants, self._current_a)

    def __call__(self, time_s: float) -> Reading:
        """Return voltage and current at the terminals at ``time_s`` [s]."""
        dt_s, self._time_s = time_s - self._time_s, time_s
        advance(self._x, self._dx, self._theta, self._file_constants, self._current_a, dt_s)
        self._remaining_s -= dt_s
        while self._remaining_s <= 0.0:
            seconds, load_a = next(self._load)
            self._current_a, self._remaining_s = max(load_a, 0.0), self._remaining_s + seconds
        voltage_v = output(self._x, self._dx, self._theta, self._file_constants, self._current_a, self._psi)
        return Reading(self._current_a, float(voltage_v), self._temperature_c)
