"""Dispatch of the learning law's functions to a model, selected by an integer.

An integer is used because numba's disk cache cannot store first-class functions. The modules ``chen_mora_sensitivity`` and
``fuel_cell`` define the functions of each model.
"""

import math
from enum import IntEnum

from bms_estimator.kernels.cell_model import fuel_cell
from bms_estimator.kernels.observer import chen_mora_sensitivity
from bms_estimator.model.arrays import Floats, Record
from bms_estimator.numba_cache import njit


class Model(IntEnum):
    """Model that is identified."""

    CHEN_MORA = 0
    FUEL_CELL = 1


_CHEN_MORA = int(Model.CHEN_MORA)
_FUEL_CELL = int(Model.FUEL_CELL)
NAMES = {Model.CHEN_MORA: chen_mora_sensitivity.NAMES, Model.FUEL_CELL: fuel_cell.NAMES}
"""Identified parameters of each model, in the order of theta."""


@njit(cache=True)
def load_constants(model: int, constants: Floats, p: Record, soc: float, temperature_c: float) -> None:
    """Load the model's constants for this sample; ``p`` is a record of ESTIMATOR_SETTINGS."""
    if model == _CHEN_MORA:
        chen_mora_sensitivity.load_constants(constants, p, soc, temperature_c)
    elif model == _FUEL_CELL:
        fuel_cell.load_constants(constants, p, soc, temperature_c)


@njit(cache=True)
def steady_state(model: int, x: Floats, dx: Floats, theta: Floats, constants: Floats, current_a: float) -> None:
    """Set states and derivatives in place to the steady state, for a sample with unknown history."""
    if model == _CHEN_MORA:
        chen_mora_sensitivity.steady_state(x, dx, theta, constants, current_a)
    elif model == _FUEL_CELL:
        fuel_cell.steady_state(x, dx, theta, constants, current_a)


@njit(cache=True)
def advance(model: int, x: Floats, dx: Floats, theta: Floats, constants: Floats, current_a: float, dt_s: float) -> None:
    """Advance states ``x`` (2,) [V] and derivatives ``dx`` (2, 8) in place by ``dt_s`` under a constant current."""
    if model == _CHEN_MORA:
        chen_mora_sensitivity.advance(x, dx, theta, constants, current_a, dt_s)
    elif model == _FUEL_CELL:
        fuel_cell.advance(x, dx, theta, constants, current_a, dt_s)


@njit(cache=True)
def output(model: int, x: Floats, dx: Floats, theta: Floats, constants: Floats, current_a: float, psi: Floats) -> float:
    """Return the terminal voltage y^ [V]; write dy^/dtheta to ``psi`` (8,)."""
    if model == _CHEN_MORA:
        return chen_mora_sensitivity.output(x, dx, theta, constants, current_a, psi)
    if model == _FUEL_CELL:
        return fuel_cell.output(x, dx, theta, constants, current_a, psi)
    return math.nan


@njit(cache=True)
def write(model: int, theta: Floats, file: Floats, a: Floats) -> None:
    """Write the published parameters ``a`` (16,) from the file's and theta."""
    if model == _CHEN_MORA:
        chen_mora_sensitivity.write(theta, file, a)
    elif model == _FUEL_CELL:
        fuel_cell.write(theta, file, a)
