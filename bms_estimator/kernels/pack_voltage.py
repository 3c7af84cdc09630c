"""Voltages that the slow fit's model of the pack predicts for history rows, and their derivatives by the unknowns.

Equation and symbols: docs/theory/pack-model.md. All voltages are of one cell.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bms_estimator.kernels.cell_model.rc_ladder import RESISTANCES
from bms_estimator.model.arrays import Floats
from bms_estimator.numba_cache import njit

RESISTANCE_GROUPS = (0, 1, 1, 1, 2, 2, 2)
"""Group of each resistance: 0 series resistance, 1 RC pairs up to 30 s, 2 slower RC pairs. Those of a group share a scale."""
MODEL_ROW = np.dtype(
    [
        ("interval", "i8"),  # interval of the row
        ("segment", "i8"),  # segment of the row, counted from 0
        ("direction", "i8"),  # 0 charge, 1 rest, 2 discharge
        ("above_25_c_k", "f8"),  # temperature above that of the cell file's curves [K]
        ("weak", "f8"),  # Arrhenius factor of the part of the resistances with the low activation energy
        ("strong", "f8"),  # Arrhenius factor of the part with the high activation energy
        ("hysteresis_factor", "f8"),  # Arrhenius factor of the hysteresis
        ("current_a", "f8", RESISTANCES),  # current through each resistance [A]
        ("start_load_a", "f8", RESISTANCES),  # what is left of a load of 1 std before the segment [A]
        ("hysteresis", "f8", 2),  # fast and slow part, counted from 0 at the start of the segment
        ("start_h_decay", "f8", 2),  # fraction that is left of both parts' values at the start of the segment
        ("aging_trend", "f8"),  # ln of the factor on the resistances for an aging of 1 std
        ("direction_v", "f8"),  # std of the error by direction [V]
    ],
    align=True,
)
"""Quantities of a history row that do not depend on the unknowns."""
COLUMNS = 20
"""Number of unknowns on which the voltage of one row depends."""


class CellTables(NamedTuple):
    """Curves of the cell file on evenly spaced SOCs 0..1."""

    one_c_a: float
    """Current of 1 C [A]."""
    ocv_v: Floats
    """OCV [V]."""
    low_slope_v: float
    """Slope of the OCV below SOC 0 [V per unit SOC]."""
    high_slope_v: float
    """Slope of the OCV above SOC 1 [V per unit SOC]."""
    parts_ohm: Floats
    """Parts of each resistance with the low, then with the high activation energy, shape (n, 2 * RESISTANCES) [ohm]."""
    hysteresis_v: Floats
    """Half of the difference of the OCV after charge and after discharge [V]."""
    per_kelvin_v: Floats
    """Temperature coefficient of the OCV [V/K]."""


class Values(NamedTuple):
    """Unknowns by kind, see ``pack_model.unknowns.Unknowns``."""

    start_hysteresis: Floats
    """Shape (segments, 2)."""
    start_load: Floats
    offset: Floats
    r: Floats
    """Factor on the resistances of each group: exp of the unknown ``ln_r``."""
    aging: float
    shape: Floats
    hysteresis: Floats
    entropy: float
    arrhenius: float
    curve: Floats
    direction: Floats
    """Shape (directions, nodes)."""


@njit(cache=True)
def node_below(soc: float, nodes: int) -> tuple[int, float]:
    """Return the evenly spaced node below an SOC, and the distance from it as a fraction of that to the next node.

    An SOC beyond 0..1 gets the position of the nearest end.
    """
    position = min(max(soc, 0.0), 1.0) * (nodes - 1)
    below = min(int(position), nodes - 2)
    return below, position - below


@njit(cache=True)
def interpolate(values: Floats, soc: float) -> float:
    """Return a piecewise linear function with the given values at evenly spaced SOCs."""
    below, high = node_below(soc, values.size)
    return (1.0 - high) * values[below] + high * values[below + 1]


@njit(cache=True)
def pack_resistances(rows: NDArray[np.void], cell: CellTables, v: Values, soc: Floats) -> Floats:
    """Return the resistances of the pack at the SOCs and temperatures of rows, shape (n, RESISTANCES) [ohm]."""
    ohm = np.empty((soc.size, RESISTANCES))
    for j in range(soc.size):
        row = rows[j]
        below, high = node_below(soc[j], cell.parts_ohm.shape[0])
        common = math.exp(interpolate(v.shape, soc[j]) + v.arrhenius * row.above_25_c_k + v.aging * row.aging_trend)
        for k in range(RESISTANCES):
            weak_ohm = (1.0 - high) * cell.parts_ohm[below, k] + high * cell.parts_ohm[below + 1, k]
            i = RESISTANCES + k
            strong_ohm = (1.0 - high) * cell.parts_ohm[below, i] + high * cell.parts_ohm[below + 1, i]
            ohm[j, k] = common * v.r[RESISTANCE_GROUPS[k]] * (row.weak * weak_ohm + row.strong * strong_ohm)
    return ohm


@njit(cache=True)
def true_currents(rows: NDArray[np.void], one_c_a: float, v: Values) -> Floats:
    """Return the currents without the sensor's offset, with the load before the segment, shape (n, RESISTANCES) [A]."""
    current_a = np.empty((rows.size, RESISTANCES))
    for j in range(rows.size):
        row = rows[j]
        offset_a, load = v.offset[row.interval] * one_c_a, v.start_load[row.segment]
        for k in range(RESISTANCES):
            current_a[j, k] = row.current_a[k] - offset_a + load * row.start_load_a[k]
    return current_a


@njit(cache=True)
def hysteresis_states(rows: NDArray[np.void], v: Values) -> Floats:
    """Return the fast and the slow part of the hysteresis, -1..1, shape (n, 2)."""
    states = np.empty((rows.size, 2))
    for j in range(rows.size):
        row = rows[j]
        for i in range(2):
            states[j, i] = row.hysteresis[i] + row.start_h_decay[i] * v.start_hysteresis[row.segment, i]
    return states


@njit(cache=True)
def voltages(rows: NDArray[np.void], cell: CellTables, v: Values, soc: Floats) -> Floats:
    """Return the voltages of rows at the SOCs ``soc``, shape (n,) [V]. ``rows`` has the dtype MODEL_ROW."""
    ohm, current_a = pack_resistances(rows, cell, v, soc), true_currents(rows, cell.one_c_a, v)
    states, voltage_v = hysteresis_states(rows, v), np.empty(soc.size)
    for j in range(soc.size):
        row, z = rows[j], soc[j]
        ocv_v = interpolate(cell.ocv_v, z) + cell.low_slope_v * min(z, 0.0) + cell.high_slope_v * max(z - 1.0, 0.0)
        ocv_v += interpolate(v.curve, z) + row.above_25_c_k * (v.entropy + interpolate(cell.per_kelvin_v, z))
        state = v.hysteresis[0] * states[j, 0] + v.hysteresis[1] * states[j, 1]
        ocv_v += row.hysteresis_factor * interpolate(cell.hysteresis_v, z) * state
        ocv_v += row.direction_v * interpolate(v.direction[row.direction], z)
        for k in range(RESISTANCES):
            ocv_v -= ohm[j, k] * current_a[j, k]
        voltage_v[j] = ocv_v
    return voltage_v


@njit(cache=True)
def voltage_derivatives(
    rows: NDArray[np.void],
    cell: CellTables,
    v: Values,
    soc: Floats,
    by_soc: Floats,
    first: NDArray[np.intp],
) -> tuple[NDArray[np.intp], Floats]:
    """Return the non-zero derivatives of the voltages by the unknowns: columns, increasing in each row, and values.

    Args:
        rows: Shape (n,), dtype MODEL_ROW.
        cell: Curves of the cell file.
        v: Unknowns.
        soc: SOC of each row.
        by_soc: Derivatives of the voltages by SOC, offset and ln_q of the interval at constant currents, shape (n, 3).
        first: First column of start_hysteresis, start_load, soc, offset, ln_q, ln_r, aging, shape, hysteresis, entropy,
            arrhenius, curve and direction.
    """
    columns, values = np.empty((soc.size, COLUMNS), np.intp), np.empty((soc.size, COLUMNS))
    ohm, current_a = pack_resistances(rows, cell, v, soc), true_currents(rows, cell.one_c_a, v)
    states = hysteresis_states(rows, v)
    for j in range(soc.size):
        row, at, d = rows[j], columns[j], values[j]
        hysteresis_v = row.hysteresis_factor * interpolate(cell.hysteresis_v, soc[j])
        for i in range(2):
            at[i], d[i] = first[0] + 2 * row.segment + i, hysteresis_v * v.hysteresis[i] * row.start_h_decay[i]
            at[12 + i], d[12 + i] = first[8] + i, hysteresis_v * states[j, i]
        at[2], d[2] = first[1] + row.segment, 0.0
        for i in range(3):
            at[3 + i], d[3 + i] = first[2 + i] + row.interval, by_soc[j, i]
            at[6 + i], d[6 + i] = first[5] + i, 0.0
        for k in range(RESISTANCES):
            d[2] -= ohm[j, k] * row.start_load_a[k]
            d[4] += ohm[j, k] * cell.one_c_a  # the offset lowers the current through the resistances
            d[6 + RESISTANCE_GROUPS[k]] -= ohm[j, k] * current_a[j, k]
        by_common = d[6] + d[7] + d[8]
        at[9], d[9] = first[6], row.aging_trend * by_common
        at[14], d[14] = first[9], row.above_25_c_k
        at[15], d[15] = first[10], row.above_25_c_k * by_common
        _write_nodes(at, d, 10, first[7], soc[j], v.shape.size, by_common)
        _write_nodes(at, d, 16, first[11], soc[j], v.curve.size, 1.0)
        nodes = v.direction.shape[1]
        _write_nodes(at, d, 18, first[12] + row.direction * nodes, soc[j], nodes, row.direction_v)
    return columns, values


@njit(cache=True)
def _write_nodes(at: NDArray[np.intp], d: Floats, i: int, first: int, soc: float, nodes: int, factor: float) -> None:
    """Write columns and derivatives of ``factor`` times an interpolated function to positions ``i`` and ``i`` + 1."""
    below, high = node_below(soc, nodes)
    at[i], at[i + 1] = first + below, first + below + 1
    d[i], d[i + 1] = factor * (1.0 - high), factor * high
