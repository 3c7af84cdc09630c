"""Number of cells in series that fits a measured voltage and a chemistry."""

import math
from dataclasses import dataclass

from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.model.cell import load_cell

BELOW_EMPTY_V, ABOVE_FULL_V = 0.5, 0.3
"""Margins below the OCV at SOC 0, for a load, and above the OCV at SOC 1, for a charger [V]. Both include differences
between manufacturers."""
COMMON_COUNTS = (1, 2, 3, 4, 6, 7, 8, 10, 12, 13, 14, 15, 16, 20, 24)
"""Numbers of cells in series of common packs."""


@dataclass(frozen=True)
class CellVoltages:
    """Voltage of a cell of one chemistry [V]."""

    min_v: float
    """Lowest plausible voltage, under load."""
    mid_v: float
    """OCV at SOC 0.5."""
    max_v: float
    """Highest plausible voltage, while it is charged."""


def cell_voltages(cell: str) -> CellVoltages:
    """Return the voltages of one cell of a generic cell or a shipped cell file."""
    model = load_cell(cell, 1.0)
    ocv_v = ocv_grid(model)[0] / model.cell.series_count
    return CellVoltages(float(ocv_v[0]) - BELOW_EMPTY_V, float(ocv_v[len(ocv_v) // 2]), float(ocv_v[-1]) + ABOVE_FULL_V)


def possible_counts(voltage_v: float, cell: CellVoltages) -> range:
    """Return the numbers of cells in series with which a pack may have a voltage [V]."""
    return range(max(math.ceil(voltage_v / cell.max_v), 1), math.floor(voltage_v / cell.min_v) + 1)


def suggest_count(voltage_v: float, cell: CellVoltages) -> int | None:
    """Return the most plausible number of cells in series; None if no number is possible.

    Numbers of common packs take precedence. Among them the best brings the cells closest to their OCV at SOC 0.5.
    """
    possible = possible_counts(voltage_v, cell)
    candidates = [count for count in possible if count in COMMON_COUNTS] or list(possible)
    return min(candidates, key=lambda count: abs(voltage_v / count - cell.mid_v), default=None)
