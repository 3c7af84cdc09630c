"""Overpotential of a cell under a measured current, with constant parameters.

The model is the RC ladder of the cell, or (2.2)-(2.9) of the thesis.
"""

import numpy as np

from bms_estimator.calibration.cleaning.clean_capture import CleanCapture
from bms_estimator.kernels.cell_model.open_loop import branch_currents, hysteresis, two_branches
from bms_estimator.kernels.cell_model.rc_ladder import GAS_J, HYSTERESIS_J, REFERENCE_C, STRONG_J, WEAK_J
from bms_estimator.kernels.kalman_filter.records import Noise
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel, Ladder, TableOcv

KELVIN = 273.15
"""Temperature of 0 C [K]."""


def arrhenius(energy_j: float, temperature_c: Floats) -> Floats:
    """Return ``kernels.cell_model.rc_ladder.arrhenius`` for an array of temperatures."""
    return np.asarray(
        np.exp(energy_j / GAS_J * (1.0 / (temperature_c + KELVIN) - 1.0 / (REFERENCE_C + KELVIN))), dtype=np.float64
    )


def linear_interpolation_matrix(soc: Floats, nodes: Floats) -> Floats:
    """Return the weights of ``nodes`` in a linear interpolation that is constant beyond the ends. Shape (n, nodes)."""
    return np.column_stack([np.interp(soc, nodes, row) for row in np.eye(nodes.size)])


def temperature_of(load: CleanCapture, otherwise_c: float = REFERENCE_C) -> Floats:
    """Return the temperature at each sample, ``otherwise_c`` without a sensor [C]."""
    return np.where(np.isfinite(load.temperature_c), load.temperature_c, otherwise_c)


def overpotential(cell: CellModel, load: CleanCapture, soc: Floats) -> Floats:
    """Return the drop of the voltage below the open-circuit voltage E_o(SOC) at 25 C, with dE/dT and hysteresis [V].

    Args:
        cell: Cell with an RC ladder, or with a1..a15, which do not depend on the temperature.
        load: Capture that starts at rest.
        soc: Shape (n,), SOC by coulomb counting.
    """
    temperature_c = temperature_of(load)
    if cell.ladder is None:
        drop_v = two_branches(load.time_s, load.current_a, soc, cell.a[:16])
    else:
        drop_v = ladder_overpotential(cell.ladder, load, soc, temperature_c)
    return drop_v - ocv_offset(cell, load, soc)


def ocv_offset(cell: CellModel, load: CleanCapture, soc: Floats) -> Floats:
    """Return the change of E_o(SOC) by temperature and hysteresis [V]. The hysteresis starts as that after a charge."""
    ocv, added_v, temperature_c = cell.ocv, np.zeros(soc.size), temperature_of(load)
    if isinstance(ocv, TableOcv) and ocv.per_kelvin_v is not None:
        added_v += np.interp(soc, ocv.soc, ocv.per_kelvin_v) * (temperature_c - REFERENCE_C)
    if isinstance(ocv, TableOcv) and ocv.hysteresis_v is not None:
        hysteresis_v = np.interp(soc, ocv.soc, ocv.hysteresis_v) * arrhenius(HYSTERESIS_J, temperature_c)
        added_v += hysteresis_v * hysteresis(load.time_s, soc, Noise().hysteresis_soc, 1.0)
    return added_v


def steady_drop(ladder: Ladder, current_a: float, soc: Floats, temperature_c: Floats, first: int) -> Floats:
    """Return the voltage drop of a current that has flowed for hours across the resistances from ``first`` on [V].

    Args:
        ladder: RC ladder of the cell.
        current_a: Positive on discharge [A].
        soc: Shape (n,).
        temperature_c: Shape (n,) [C].
        first: Index of the first resistance; 0 is the ohmic one.
    """
    weak_ohm, strong_ohm = (
        linear_interpolation_matrix(soc, np.array(ladder.soc)) @ np.array(part[first:]).sum(axis=0)
        for part in (ladder.weak_ohm, ladder.strong_ohm)
    )
    ohm = arrhenius(WEAK_J, temperature_c) * weak_ohm + arrhenius(STRONG_J, temperature_c) * strong_ohm
    return np.asarray(current_a * ohm)


def ladder_overpotential(ladder: Ladder, load: CleanCapture, soc: Floats, temperature_c: Floats) -> Floats:
    """Return the overpotential of the ladder, with its ohmic drop [V]."""
    currents = np.column_stack([load.current_a, branch_currents(load.time_s, load.current_a)])
    node_weights = linear_interpolation_matrix(soc, np.array(ladder.soc))
    weak_v = ((node_weights @ np.array(ladder.weak_ohm).T) * currents).sum(axis=1)
    strong_v = ((node_weights @ np.array(ladder.strong_ohm).T) * currents).sum(axis=1)
    return np.asarray(arrhenius(WEAK_J, temperature_c) * weak_v + arrhenius(STRONG_J, temperature_c) * strong_v)
