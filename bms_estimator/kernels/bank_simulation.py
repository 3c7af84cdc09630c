"""Simulation of a bank of cells in series, each with its own capacity, resistance, temperature and internal short."""

import numpy as np

from bms_estimator.kernels.accumulators.history import HYSTERESIS_SOC
from bms_estimator.kernels.cell_model.rc_ladder import (
    BRANCHES,
    HIGH_ACTIVATION_ENERGY,
    HYSTERESIS_ACTIVATION_ENERGY,
    LOW_ACTIVATION_ENERGY,
    RESISTANCES,
    TAUS,
    arrhenius,
    on_grid,
    resistances,
)
from bms_estimator.model.arrays import Floats, Record
from bms_estimator.numba_cache import njit

COLLAPSE_V = 50.0
"""Slope of the OCV of a cell below SOC 0 [V per unit SOC]. The voltage of an over-discharged cell falls to 0 within a few
percent of its capacity. Assumed."""
TAPER_C = 0.05
"""Current at which the charger ends the charge, as a C-rate of the mean capacity."""
FAST_FRACTION = 0.6
"""Fraction of the hysteresis that follows the charge with the first (shorter) constant of ``HYSTERESIS_SOC``."""
STATE = np.dtype(
    [
        ("soc", "f8"),
        ("x_a", "f8", BRANCHES),  # current filtered by the RC pairs [A]
        ("hysteresis", "f8", 2),  # fast and slow part, -1..1
    ]
)
"""State of one cell."""


@njit(cache=True)
def simulate(
    p: Record,
    state: Record,
    properties: Floats,
    limits_v: Floats,
    stopped: Floats,
    step_s: float,
    bank_c: Floats,
    current_a: Floats,
    cell_v: Floats,
    cell_soc: Floats,
) -> None:
    """Simulate a bank.

    Args:
        p: Record of dtype EKF_SETTINGS of one cell.
        state: Shape (cells,), dtype ``STATE``; updated.
        properties: Capacity [A s], factor on the resistances, resistance of the internal short [ohm] and temperature above
            that of the bank [K], shape (4, cells).
        limits_v: Cut-off voltage and charger voltage of the bank [V].
        stopped: Direction of the current that a limit has switched off: 1 discharge, -1 charge, 0 none; shape (1,); updated.
        step_s: Interval between two times [s].
        bank_c: Temperature of the bank [degC], shape (n,).
        current_a: Requested current, replaced by the current that flowed [A], shape (n,).
        cell_v: Voltage of each cell [V], shape (n, cells); written.
        cell_soc: SOC of each cell, shape (n, cells); written.
    """
    cells, ohm, capacity_as = state.size, np.zeros(RESISTANCES), properties[0]
    for n in range(current_a.size):
        i = current_a[n]
        if i * stopped[0] > 0.0:
            i = 0.0
        elif i != 0.0:
            stopped[0] = 0.0
        series_ohm = 0.0
        for c in range(cells):
            cell_v[n, c] = cell_voltage(p, state[c], i, properties[1, c], bank_c[n] + properties[3, c], ohm)
            cell_soc[n, c] = state[c].soc
            series_ohm += properties[1, c] * ohm[0]
        bank_v = cell_v[n].sum()
        if i < 0.0 and bank_v > limits_v[1]:  # constant voltage
            limited_a = min(i + (bank_v - limits_v[1]) / series_ohm, 0.0)
            cell_v[n] -= (limited_a - i) * series_ohm / cells
            i = limited_a
            stopped[0] = -1.0 if i > -TAPER_C * capacity_as.mean() / 3600.0 else 0.0
        elif i > 0.0 and bank_v < limits_v[0]:
            stopped[0] = 1.0
        current_a[n] = i
        for c in range(cells):
            advance(state[c], i, i + cell_v[n, c] / properties[2, c], step_s, capacity_as[c])


@njit(cache=True)
def cell_voltage(p: Record, s: Record, current_a: float, ohm_factor: float, celsius: float, ohm: Floats) -> float:
    """Return the voltage of one cell [V].

    Args:
        p: Record of dtype EKF_SETTINGS of one cell.
        s: Record of dtype ``STATE``.
        current_a: Current [A], positive on discharge.
        ohm_factor: Factor on the resistances.
        celsius: Temperature of the cell [degC].
        ohm: Resistances of the cell file [ohm], shape (RESISTANCES,); written.
    """
    resistances(
        s.soc,
        p.weak_ohm,
        p.strong_ohm,
        arrhenius(LOW_ACTIVATION_ENERGY, celsius),
        arrhenius(HIGH_ACTIVATION_ENERGY, celsius),
        ohm,
    )
    drop_v = current_a * ohm[0]
    for k in range(BRANCHES):
        drop_v += ohm[1 + k] * s.x_a[k]
    return float(open_circuit(p, s, celsius) - ohm_factor * drop_v)


@njit(cache=True)
def open_circuit(p: Record, s: Record, celsius: float) -> float:
    """Return the open-circuit voltage with hysteresis of one cell [V].

    ``p`` is a record of dtype EKF_SETTINGS, ``s`` one of dtype ``STATE``.
    """
    position = min(max(s.soc, 0.0), 1.0) * (p.ocv_v.size - 1)
    j = min(int(position), p.ocv_v.size - 2)
    ocv_v = p.ocv_v[j] + (position - j) * (p.ocv_v[j + 1] - p.ocv_v[j])
    ocv_v += (s.soc - 1.0) * p.ocv_slope_v[-1] if s.soc > 1.0 else 0.0
    h = FAST_FRACTION * s.hysteresis[0] + (1.0 - FAST_FRACTION) * s.hysteresis[1]
    ocv_v += h * arrhenius(HYSTERESIS_ACTIVATION_ENERGY, celsius) * on_grid(s.soc, p.hysteresis_v)
    ocv_v += (celsius - 25.0) * on_grid(s.soc, p.per_kelvin_v)
    return float(max(ocv_v + COLLAPSE_V * min(s.soc, 0.0), 0.0))


@njit(cache=True)
def advance(s: Record, current_a: float, drawn_a: float, step_s: float, capacity_as: float) -> None:
    """Advance the state of one cell.

    Args:
        s: Record of dtype ``STATE``; updated.
        current_a: Current of the bank [A], positive on discharge.
        drawn_a: Current of the cell, which includes that of its internal short [A].
        step_s: Duration [s].
        capacity_as: Capacity of the cell [A s].
    """
    for k in range(BRANCHES):
        s.x_a[k] = current_a + (s.x_a[k] - current_a) * np.exp(-step_s / TAUS[k])
    drawn_soc = drawn_a * step_s / capacity_as
    s.soc -= drawn_soc
    for k in range(2):
        weight = 1.0 - np.exp(-abs(drawn_soc) / HYSTERESIS_SOC[k])
        s.hysteresis[k] -= weight * (s.hysteresis[k] + np.sign(drawn_soc))
