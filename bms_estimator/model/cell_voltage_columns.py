"""Columns of cell voltages in a capture table: ``cell_1_v``, ``cell_2_v`` and so on."""

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from bms_estimator.model.sample import CellBlock


def column_name(cell: int) -> str:
    """Return the name of the column of a cell, numbered from 1."""
    return f"cell_{cell}_v"


def present_columns(names: Collection[str]) -> list[str]:
    """Return the columns of cells 1, 2, ... that a table has, up to the first missing one."""
    columns = list[str]()
    while (name := column_name(len(columns) + 1)) in names:
        columns.append(name)
    return columns


def cell_voltage_columns(cells_v: CellBlock, rows: int, cells: int) -> NDArray[np.void]:
    """Return cell voltages as a structured array with ``rows`` rows and the columns of ``cells`` cells.

    Voltages of another number of cells are replaced by NaN.
    """
    columns = np.empty(rows, [(column_name(cell + 1), "f8") for cell in range(cells)])
    for cell, name in enumerate(columns.dtype.names or ()):
        columns[name] = cells_v[:, cell] if cells_v.shape == (rows, cells) else np.nan
    return columns
