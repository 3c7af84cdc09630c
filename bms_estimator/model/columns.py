"""Columns of a capture, of its cell voltages or of its estimates, by name. Names contain the unit."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bms_estimator.model.arrays import CellBlock


@dataclass(frozen=True, eq=False)
class Columns(Mapping[str, NDArray[Any]]):
    """Columns of equal length, a mapping from name to array.

    Attributes:
        rows: Shape (n,), structured array with the columns as fields, as in ``Estimator.run``.
        name: Name of the capture for messages.
        note: Text that says what was guessed about the file of the capture; empty if nothing was.
        warning: Contradiction in the file that the user should resolve; empty without one.
    """

    rows: NDArray[np.void]
    name: str = ""
    note: str = ""
    warning: str = ""

    def __getitem__(self, name: str) -> NDArray[Any]:
        if name not in self.names:
            raise KeyError(f"{name}: no such column; there are {', '.join(self.names)}")
        column: NDArray[Any] = self.rows[name]
        return column

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns, in order."""
        return self.rows.dtype.names or ()

    def to_pandas(self) -> Any:
        """Return the columns as a ``pandas.DataFrame``; needs pandas."""
        import pandas as pd  # noqa: PLC0415 - optional

        return pd.DataFrame(self.rows)


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
