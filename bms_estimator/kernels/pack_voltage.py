"""Voltages that the slow fit's model of the pack predicts for history rows, and their derivatives by the unknowns.

Equation and symbols: docs/theory/pack-model.md. All voltages are of one cell.
"""

import math

import numpy as np
from numpy.typing import NDArray

from bms_estimator.kernels.cell_model.rc_ladder import RESISTANCES
from bms_estimator.model.arrays import Floats
from bms_estimator.numba_cache import njit

CURVE_NODES, DIRECTION_NODES, SHAPE_NODES = 101, 51, 6
"""Number of SOC nodes of the OCV's error, of the direction-dependent error, and of the error of the resistances."""
RESISTANCE_GROUPS = (0, 1, 1, 1, 2, 2, 2)
"""Group of each resistance: 0 series resistance, 1 RC pairs up to 30 s, 2 slower RC pairs. All resistances of a group share a scale."""
MODEL_ROW = np.dtype(
    [
        ("one_c_a", "f8"),  # current of 1 C [A]
        ("interval", "i8"),  # interval of the row
        ("segment", "i8"),  # segment of the row, counted from 0
        ("direction", "i8"),  # 0 charge, 1 rest, 2 discharge
        ("above_25_c_k", "f8"),  # temperature above that of the cell file's curves [K]
        ("weak", "f8"),  # Arrhenius factor of the part of the resistances with the low activation energy
        ("strong", "f8"),  # Arrhenius factor of the part with the high activation energy
        ("hysteresis_factor", "f8"),  # Arrhenius factor of the hysteresis
        ("current_a", "f8", RESISTANCES),  # current through each resistance [A]
        ("start_load_a", "f8", RESISTANCES),  # remainder of a load of 1 std before the segment [A]
        ("hysteresis", "f8", 2),  # fast and slow part, counted from 0 at the start of the segment
        ("start_h_decay", "f8", 2),  # remaining fraction of both parts' values at the start of the segment
        ("aging_trend", "f8"),  # ln of the factor on the resistances for an aging of 1 std
        ("direction_v", "f8"),  # std of the direction-dependent error [V]
    ],
    align=True,
)
"""Quantities of a history row that do not depend on the unknowns."""
COLUMNS = 20
"""Number of unknowns on which the voltage of one row depends: 2, 1, 1, 1, 1, 3, 1, 2, 2, 1, 1, 2 and 2 of the kinds below."""


START_H, START_LOAD, SOC, OFFSET, LN_Q, LN_R, AGING, SHAPE, HYSTERESIS, ENTROPY, ARRHENIUS, CURVE, DIRECTION = range(13)
"""Kinds of unknowns in the order of their columns. ``first`` is an array of their first columns in the vector of unknowns."""
FILE_HYSTERESIS, FILE_ENTROPY = 2 * RESISTANCES, 2 * RESISTANCES + 1
"""Columns in the table of a cell file, after the parts of each resistance with the low and with the high activation energy.
The rows of the table are evenly spaced SOCs 0..1."""


@njit(cache=True)
def node_below(soc: float, nodes: int) -> tuple[int, float]:
    """Return the evenly spaced node below an SOC, and the fraction of the distance to the next one.

    An SOC beyond 0..1 gets the position of the nearest end.
    """
    position = min(max(soc, 0.0), 1.0) * (nodes - 1)
    below = min(int(position), nodes - 2)
    return below, position - below


@njit(cache=True)
def interpolate(values: Floats, start: int, nodes: int, soc: float) -> float:
    """Return the piecewise linear function whose values at evenly spaced SOCs begin at ``values[start]``."""
    below, fraction = node_below(soc, nodes)
    return (1.0 - fraction) * values[start + below] + fraction * values[start + below + 1]


@njit(cache=True)
def resistances_and_currents(
    rows: NDArray[np.void], table: Floats, x: Floats, first: NDArray[np.intp], soc: Floats
) -> tuple[Floats, Floats]:
    """Return resistances of the pack [ohm] and true currents through them [A], each of shape (n, RESISTANCES).

    The true currents are without the sensor's offset, and with the load before the segment.
    """
    ohm, current_a = np.empty((soc.size, RESISTANCES)), np.empty((soc.size, RESISTANCES))
    r = np.exp(x[first[LN_R] : first[LN_R] + 3])
    for j in range(soc.size):
        row, (below, fraction) = rows[j], node_below(soc[j], table.shape[0])
        common = math.exp(
            interpolate(x, first[SHAPE], SHAPE_NODES, soc[j])
            + x[first[ARRHENIUS]] * row.above_25_c_k
            + x[first[AGING]] * row.aging_trend
        )
        offset_a, load = x[first[OFFSET] + row.interval] * row.one_c_a, x[first[START_LOAD] + row.segment]
        for k in range(RESISTANCES):
            scale, i = common * r[RESISTANCE_GROUPS[k]], RESISTANCES + k
            weak_ohm = row.weak * ((1.0 - fraction) * table[below, k] + fraction * table[below + 1, k])
            ohm[j, k] = scale * (
                weak_ohm + row.strong * ((1.0 - fraction) * table[below, i] + fraction * table[below + 1, i])
            )
            current_a[j, k] = row.current_a[k] - offset_a + load * row.start_load_a[k]
    return ohm, current_a


@njit(cache=True)
def voltages(
    rows: NDArray[np.void], table: Floats, x: Floats, first: NDArray[np.intp], soc: Floats, ocv_v: Floats
) -> Floats:
    """Return the voltages of rows, shape (n,) [V].

    Args:
        rows: Shape (n,), dtype MODEL_ROW.
        table: Curves of the cell file, see ``FILE_HYSTERESIS``.
        x: Unknowns.
        first: First column of each kind of unknown.
        soc: SOC of each row.
        ocv_v: OCV of the cell file at these SOCs [V].
    """
    ohm, current_a = resistances_and_currents(rows, table, x, first, soc)
    voltage_v = ocv_v.copy()
    for j in range(soc.size):
        row, z, (below, fraction) = rows[j], soc[j], node_below(soc[j], table.shape[0])
        entropy = (1.0 - fraction) * table[below, FILE_ENTROPY] + fraction * table[below + 1, FILE_ENTROPY]
        voltage_v[j] += interpolate(x, first[CURVE], CURVE_NODES, z) + row.above_25_c_k * (x[first[ENTROPY]] + entropy)
        voltage_v[j] += row.direction_v * interpolate(
            x, first[DIRECTION] + row.direction * DIRECTION_NODES, DIRECTION_NODES, z
        )
        hysteresis_v = (1.0 - fraction) * table[below, FILE_HYSTERESIS] + fraction * table[below + 1, FILE_HYSTERESIS]
        for i in range(2):
            state = row.hysteresis[i] + row.start_h_decay[i] * x[first[START_H] + 2 * row.segment + i]
            voltage_v[j] += x[first[HYSTERESIS] + i] * row.hysteresis_factor * hysteresis_v * state
        for k in range(RESISTANCES):
            voltage_v[j] -= ohm[j, k] * current_a[j, k]
    return voltage_v


@njit(cache=True)
def voltage_derivatives(
    rows: NDArray[np.void], table: Floats, x: Floats, first: NDArray[np.intp], soc: Floats, by_soc: Floats
) -> tuple[NDArray[np.intp], Floats]:
    """Return the non-zero derivatives of the voltages by the unknowns: columns, increasing in each row, and values.

    Args:
        rows: Shape (n,), dtype MODEL_ROW.
        table: Curves of the cell file, see ``FILE_HYSTERESIS``.
        x: Unknowns.
        first: First column of each kind of unknown.
        soc: SOC of each row.
        by_soc: Derivatives of the voltages by SOC, offset and ln_q of the interval at constant currents, shape (n, 3).
    """
    columns, values = np.empty((soc.size, COLUMNS), np.intp), np.zeros((soc.size, COLUMNS))
    ohm, current_a = resistances_and_currents(rows, table, x, first, soc)
    for j in range(soc.size):
        row, at, d, (below, fraction) = rows[j], columns[j], values[j], node_below(soc[j], table.shape[0])
        file_v = (1.0 - fraction) * table[below, FILE_HYSTERESIS] + fraction * table[below + 1, FILE_HYSTERESIS]
        for i in range(2):
            at[i], at[12 + i] = first[START_H] + 2 * row.segment + i, first[HYSTERESIS] + i
            d[12 + i] = row.hysteresis_factor * file_v * (row.hysteresis[i] + row.start_h_decay[i] * x[at[i]])
            d[i] = row.hysteresis_factor * file_v * x[at[12 + i]] * row.start_h_decay[i]
        at[2], at[9] = first[START_LOAD] + row.segment, first[AGING]
        for i in range(3):
            at[3 + i], at[6 + i], d[3 + i] = first[SOC + i] + row.interval, first[LN_R] + i, by_soc[j, i]
        for k in range(RESISTANCES):
            d[2] -= ohm[j, k] * row.start_load_a[k]
            d[4] += ohm[j, k] * row.one_c_a  # the offset lowers the current through the resistances
            d[6 + RESISTANCE_GROUPS[k]] -= ohm[j, k] * current_a[j, k]
        by_ln_r = d[6] + d[7] + d[8]
        at[14], at[15] = first[ENTROPY], first[ARRHENIUS]
        d[9], d[14], d[15] = row.aging_trend * by_ln_r, row.above_25_c_k, row.above_25_c_k * by_ln_r
        _write_nodes(at, d, 10, first[SHAPE], soc[j], SHAPE_NODES, by_ln_r)
        _write_nodes(at, d, 16, first[CURVE], soc[j], CURVE_NODES, 1.0)
        _write_nodes(
            at, d, 18, first[DIRECTION] + row.direction * DIRECTION_NODES, soc[j], DIRECTION_NODES, row.direction_v
        )
    return columns, values


@njit(cache=True)
def _write_nodes(at: NDArray[np.intp], d: Floats, i: int, first: int, soc: float, nodes: int, factor: float) -> None:
    """Write columns and derivatives of ``factor`` times an interpolated function to positions ``i`` and ``i`` + 1."""
    below, fraction = node_below(soc, nodes)
    at[i], at[i + 1] = first + below, first + below + 1
    d[i], d[i + 1] = factor * (1.0 - fraction), factor * fraction
