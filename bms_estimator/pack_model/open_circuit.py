"""Open-circuit voltage E_o of history rows.

E_o is the measured voltage, corrected for load, hysteresis and temperature with the parameters of a fit.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bms_estimator.kernels.bank_simulation import COLLAPSE_V
from bms_estimator.kernels.cell_model.rc_ladder import (
    HIGH_ACTIVATION_ENERGY,
    HYSTERESIS_ACTIVATION_ENERGY,
    LOW_ACTIVATION_ENERGY,
    REFERENCE_C,
)
from bms_estimator.kernels.pack_voltage import RESISTANCE_GROUPS
from bms_estimator.model.arrays import Floats
from bms_estimator.pack_model.cell_curves import (
    SECANT_HALF_WIDTH_SOC,
    SOC_GRID,
    CellCurves,
    NodePosition,
    arrhenius,
)
from bms_estimator.pack_model.fit import LN_Q, OFFSET, SOC, PackFit


@dataclass(frozen=True)
class OpenCircuit:
    """Open-circuit voltages of n rows, as differences from the fitted OCV. All voltages are those of the mean cell."""

    soc: Floats
    """SOC of the mean cell."""
    error_v: Floats
    """E_o minus the fitted OCV at ``soc`` [V]."""
    drop_v: Floats
    """Overpotential that was added to the measured voltage, positive on discharge [V]."""
    temperature_c: Floats
    """Temperature [degC]."""
    overpotential: "Overpotential"
    """Overpotential as a function of SOC, under the currents of the rows."""

    @classmethod
    def of(cls, cell: CellCurves, fit: PackFit, rows: NDArray[np.void], soc: Floats) -> "OpenCircuit":
        """Return the open-circuit voltages of rows.

        Args:
            cell: Curves of the cell file.
            fit: Fit of the history; the rows may be later than its last row.
            rows: Rows with a measured voltage, shape (n,), dtype HISTORY_ROW.
            soc: SOC of the rows, shape (n,).
        """
        temperature_c = rows["temperature_c"]
        overpotential = Overpotential(cell, fit, rows)
        drop_v = overpotential.at(soc[:, None])[:, 0]
        hysteresis_v = (
            fit.hysteresis
            * arrhenius(HYSTERESIS_ACTIVATION_ENERGY, temperature_c)
            * np.interp(soc, SOC_GRID, cell.hysteresis_v)
        )
        e_o_v = rows["voltage_v"] / cell.series + drop_v - hysteresis_v * rows["hysteresis"].mean(axis=1)
        e_o_at_25_c_v = e_o_v - (temperature_c - REFERENCE_C) * np.interp(soc, SOC_GRID, cell.per_kelvin_v)
        return cls(soc, e_o_at_25_c_v - fitted_ocv(cell, fit, soc), drop_v, temperature_c, overpotential)


class Overpotential:
    """Overpotential of the mean cell as a function of SOC, under the currents of n rows and with the fitted resistances.

    Args:
        cell: Curves of the cell file.
        fit: Fit of the history.
        rows: Shape (n,), dtype HISTORY_ROW.
    """

    def __init__(self, cell: CellCurves, fit: PackFit, rows: NDArray[np.void]) -> None:
        one, scale = np.ones(SOC_GRID.size), np.exp(fit.ln_r)[:, RESISTANCE_GROUPS]
        weak_ohm = scale * cell.resistances(SOC_GRID, one, 0.0 * one)
        strong_ohm = scale * cell.resistances(SOC_GRID, 0.0 * one, one)
        current_a = np.column_stack([rows["current_a"], rows["x_a"]]) - fit.mean[OFFSET] * cell.one_c_a
        weak, strong = (
            arrhenius(LOW_ACTIVATION_ENERGY, rows["temperature_c"]),
            arrhenius(HIGH_ACTIVATION_ENERGY, rows["temperature_c"]),
        )
        self._grid_v = weak[:, None] * (current_a @ weak_ohm.T) + strong[:, None] * (current_a @ strong_ohm.T)

    def at(self, soc: Floats) -> Floats:
        """Return the overpotential of row j at ``soc[j]``, positive on discharge, shape of ``soc``: (n, m) [V]."""
        position, row = NodePosition.of(soc, SOC_GRID.size), np.arange(soc.shape[0])[:, None]
        low, high = position.weights
        return np.asarray(low * self._grid_v[row, position.below] + high * self._grid_v[row, position.below + 1])


def row_soc(cell: CellCurves, fit: PackFit, rows: NDArray[np.void]) -> Floats:
    """Return the SOC of rows.

    Up to the last row of the fit, it is the fitted SOC. For later rows, it is the SOC at the end of the fit minus the charge
    drawn since then. If a gap separates a row from the fit, it is the SOC of the filter.
    """
    since_fit = drawn_soc(cell, fit, rows["charge_as"] - fit.charge_as)
    counted = np.where(rows["segment"] == fit.segment, fit.mean[SOC] - since_fit, rows["soc"])
    if fit.row_elapsed_s.size == 0:
        return np.asarray(counted)
    fitted = np.interp(rows["elapsed_s"], fit.row_elapsed_s, fit.row_soc)
    return np.asarray(np.where(rows["elapsed_s"] <= fit.elapsed_s, fitted, counted))


def drawn_soc(cell: CellCurves, fit: PackFit, charge_as: Floats) -> Floats:
    """Return a charge [A s] as a fraction of the fitted capacity."""
    return np.asarray(charge_as / (cell.capacity_as * math.exp(fit.mean[LN_Q])))


def fitted_ocv(cell: CellCurves, fit: PackFit, soc: Floats) -> Floats:
    """Return the fitted OCV of the mean cell [V]. Below SOC 0 it falls with the slope ``COLLAPSE_V`` to 0 V."""
    ocv_v = cell.ocv(np.maximum(soc, 0.0)) + np.interp(soc, SOC_GRID, fit.curve_v) + COLLAPSE_V * np.minimum(soc, 0.0)
    return np.asarray(np.maximum(ocv_v, 0.0))


def fitted_slope(cell: CellCurves, fit: PackFit, soc: Floats) -> Floats:
    """Return the slope of the fitted OCV as a secant over the SOC range of a row [V per unit SOC]."""
    above_v, below_v = (fitted_ocv(cell, fit, soc + shift) for shift in (SECANT_HALF_WIDTH_SOC, -SECANT_HALF_WIDTH_SOC))
    return np.asarray((above_v - below_v) / (2.0 * SECANT_HALF_WIDTH_SOC))
