"""Overpotential of a cell under a measured current, with constant parameters.

The model is the RC ladder of the cell, or (2.2)-(2.9) of the thesis.
"""

import numpy as np

from bms_estimator.calibration.cleaning.clean_capture import CleanCapture
from bms_estimator.kernels.cell_model.open_loop import branch_currents_from, hysteresis, two_branches
from bms_estimator.kernels.cell_model.rc_ladder import (
    BRANCHES,
    GAS_CONSTANT,
    HIGH_ACTIVATION_ENERGY,
    HYSTERESIS_ACTIVATION_ENERGY,
    LOW_ACTIVATION_ENERGY,
    REFERENCE_C,
)
from bms_estimator.kernels.kalman_filter.records import Noise
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel
from bms_estimator.model.cell_sections import Ladder, TableOcv

KELVIN = 273.15
"""Temperature of 0 C [K]."""
BLOCK_SAMPLES = 1 << 16
"""Number of samples for which voltages are computed at once. It limits the memory of long captures."""


def arrhenius(energy_j: float, temperature_c: Floats) -> Floats:
    """Return ``kernels.cell_model.rc_ladder.arrhenius`` for an array of temperatures."""
    return np.asarray(
        np.exp(energy_j / GAS_CONSTANT * (1.0 / (temperature_c + KELVIN) - 1.0 / (REFERENCE_C + KELVIN))),
        dtype=np.float64,
    )


def linear_interpolation_matrix(soc: Floats, nodes: Floats) -> Floats:
    """Return the weights of ``nodes`` in a linear interpolation that is constant beyond the ends. Shape (n, nodes)."""
    return np.column_stack([np.interp(soc, nodes, row) for row in np.eye(nodes.size)])


def temperature_of(capture: CleanCapture, otherwise_c: float = REFERENCE_C) -> Floats:
    """Return the temperature at each sample, ``otherwise_c`` without a sensor [C]."""
    measured = np.isfinite(capture.temperature_c)
    return capture.temperature_c if measured.all() else np.where(measured, capture.temperature_c, otherwise_c)


def overpotential(cell: CellModel, capture: CleanCapture, soc: Floats) -> Floats:
    """Return the drop of the voltage below the open-circuit voltage E_o(SOC) at 25 C, with dE/dT and hysteresis [V].

    Args:
        cell: Cell with an RC ladder, or with a1..a15, which do not depend on the temperature.
        capture: Capture that starts at rest.
        soc: Shape (n,), SOC by coulomb counting.
    """
    temperature_c = temperature_of(capture)
    if cell.ladder is None:
        drop_v = two_branches(capture.time_s, capture.current_a, soc, cell.a[:16])
    else:
        drop_v = ladder_overpotential(cell.ladder, capture, soc, temperature_c)
    return drop_v - ocv_offset(cell, capture, soc)


def ocv_offset(cell: CellModel, capture: CleanCapture, soc: Floats) -> Floats:
    """Return the change of E_o(SOC) by temperature and hysteresis [V]. The hysteresis starts as that after a charge."""
    ocv, added_v, temperature_c = cell.ocv, np.zeros(soc.size), temperature_of(capture)
    if not isinstance(ocv, TableOcv):
        return added_v
    if ocv.hysteresis_v is not None:
        added_v += hysteresis(capture.time_s, soc, Noise().hysteresis_soc, 1.0)
    for begin in range(0, soc.size, BLOCK_SAMPLES):
        block = slice(begin, begin + BLOCK_SAMPLES)
        if ocv.hysteresis_v is not None:
            half_width_v = np.interp(soc[block], ocv.soc, ocv.hysteresis_v)
            added_v[block] *= half_width_v * arrhenius(HYSTERESIS_ACTIVATION_ENERGY, temperature_c[block])
        if ocv.per_kelvin_v is not None:
            per_kelvin_v = np.interp(soc[block], ocv.soc, ocv.per_kelvin_v)
            added_v[block] += per_kelvin_v * (temperature_c[block] - REFERENCE_C)
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
    ohm = (
        arrhenius(LOW_ACTIVATION_ENERGY, temperature_c) * weak_ohm
        + arrhenius(HIGH_ACTIVATION_ENERGY, temperature_c) * strong_ohm
    )
    return np.asarray(current_a * ohm)


def ladder_overpotential(ladder: Ladder, capture: CleanCapture, soc: Floats, temperature_c: Floats) -> Floats:
    """Return the overpotential of the ladder, with its ohmic drop [V]."""
    drop_v = np.empty(soc.size)
    last_a = np.zeros(BRANCHES)
    for begin in range(0, soc.size, BLOCK_SAMPLES):
        block, first = slice(begin, begin + BLOCK_SAMPLES), max(begin - 1, 0)
        branches_a = branch_currents_from(
            last_a, capture.time_s[first : block.stop], capture.current_a[first : block.stop]
        )
        last_a = branches_a[-1]
        currents = np.column_stack([capture.current_a[block], branches_a[begin - first :]])
        node_weights = linear_interpolation_matrix(soc[block], np.array(ladder.soc))
        weak_v = ((node_weights @ np.array(ladder.weak_ohm).T) * currents).sum(axis=1)
        strong_v = ((node_weights @ np.array(ladder.strong_ohm).T) * currents).sum(axis=1)
        weak, strong = (
            arrhenius(energy_j, temperature_c[block]) for energy_j in (LOW_ACTIVATION_ENERGY, HIGH_ACTIVATION_ENERGY)
        )
        drop_v[block] = weak * weak_v + strong * strong_v
    return drop_v
