"""Reader of spreadsheets (.xlsx, .xls, .ods) with python-calamine."""

import itertools
import re
from collections.abc import Iterator, Sequence
from datetime import date, datetime, time, timedelta
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bms_estimator.model.errors import UserError
from bms_estimator.sources.captures.tables.cell_values import CellKind
from bms_estimator.sources.captures.tables.column_tables import parse_column
from bms_estimator.sources.captures.tables.layout import REQUIRED, Column, Layout, RawBlock, Role, with_time_kinds
from bms_estimator.sources.captures.tables.layout_finder import LayoutFinder

MAX_HEADER_ROWS = 100
"""Maximum number of rows of a sheet that are searched for the header."""
DATA_SHEETS = ("channel", "record", "detail")
"""Beginnings of the names of sheets with samples, by Arbin and Neware. Their other sheets have the same columns, but one row
for each step or cycle."""
_CONTINUATION = re.compile(r"_\d+$")
"""Ending of the name of a sheet that continues another, because a sheet of an .xls file has at most 65,536 rows."""

_Row = list[Any]


class _Sheet(NamedTuple):
    """Sheet with a header."""

    name: str
    layout: Layout
    rows: list[_Row]
    """Rows below the header."""


class Spreadsheet:
    """Reader of a spreadsheet, as one block.

    Args:
        path: The file.
        finder: Finder of the columns of a sample.

    Raises:
        UserError: The file cannot be read, no sheet has the columns, or several sheets have them.
    """

    warning = ""

    def __init__(self, path: Path, finder: LayoutFinder) -> None:
        self._path, self.fraction = path, 0.0
        sheets = self._data_sheets(finder)
        self.layout = sheets[0].layout
        self._rows = list(itertools.chain.from_iterable(sheet.rows for sheet in sheets))
        self.description = f"sheet {', '.join(sheet.name for sheet in sheets)}"

    def blocks(self) -> Iterator[RawBlock]:
        """Yield all rows that have a time, a current or a voltage.

        Raises:
            UserError: A cell is not valid; the message names its row.
        """
        columns = self.layout.columns
        required = [columns[Role(quantity)].index for quantity in REQUIRED]
        rows = [row for row in self._rows if any(row[index] != "" for index in required)]
        if not rows:
            raise UserError(f"{self._path}: no samples")
        yield {role: self._values(column, rows) for role, column in columns.items()}
        self.fraction = 1.0

    def _values(self, column: Column, rows: Sequence[_Row]) -> np.ndarray[Any, np.dtype[np.float64]]:
        cells = [row[column.index] for row in rows]
        if column.kind is CellKind.NUMBER and all(isinstance(cell, int | float) for cell in cells):
            return np.array(cells, dtype=np.float64)
        return parse_column(self._path, column, [None if cell == "" else _cell_text(cell) for cell in cells])

    def _data_sheets(self, finder: LayoutFinder) -> list[_Sheet]:
        """Return the sheet with the samples, and the sheets that continue it."""
        names, tables = self._read()
        if finder.sheet is not None and finder.sheet not in names:
            raise UserError(f"{self._path}: no sheet {finder.sheet}; there are {', '.join(names)}")
        found = [sheet for sheet in map(self._find_header, names, tables, itertools.repeat(finder)) if sheet]
        if finder.sheet is not None:
            found = [
                sheet for sheet in found if _CONTINUATION.sub("", sheet.name) == _CONTINUATION.sub("", finder.sheet)
            ]
        sheets = [sheet for sheet in found if sheet.name.lower().startswith(DATA_SHEETS)] or found
        if not sheets:
            raise finder.no_header_error()
        if len({_CONTINUATION.sub("", sheet.name) for sheet in sheets}) > 1:
            several = ", ".join(sheet.name for sheet in sheets)
            raise UserError(
                f"{self._path}: several sheets have samples ({several}): choose one by --map sheet={sheets[0].name} "
                "(in Python: column_map)"
            )
        return sheets

    def _read(self) -> tuple[list[str], list[list[_Row]]]:
        """Return names and rows of all sheets."""
        import python_calamine as calamine  # noqa: PLC0415 - optional

        try:
            workbook = calamine.CalamineWorkbook.from_path(self._path)
            names = workbook.sheet_names
            return names, [workbook.get_sheet_by_name(name).to_python() for name in names]
        except (calamine.CalamineError, OSError, ValueError) as error:
            raise UserError(f"{self._path}: damaged, or not a spreadsheet: {error}") from None

    @staticmethod
    def _find_header(name: str, rows: list[_Row], finder: LayoutFinder) -> _Sheet | None:
        """Return a sheet with the layout of its header; None if it has no header."""
        for index, row in enumerate(rows[:MAX_HEADER_ROWS]):
            layout = finder.find([_cell_text(cell) for cell in row])
            if layout is None:
                continue
            below = rows[index + 1 :]
            if below and (layout_with_units := finder.with_units(layout, [_cell_text(cell) for cell in below[0]])):
                layout, below = layout_with_units, below[1:]
            return _Sheet(name, with_time_kinds(layout, partial(_cell_texts, below)), below)
        return None


def _cell_texts(rows: Sequence[_Row], column: Column) -> Iterator[str]:
    return (_cell_text(row[column.index]) for row in rows if row[column.index] != "")


def _cell_text(cell: Any) -> str:
    """Return a cell as the text that a text file would contain."""
    if isinstance(cell, timedelta):
        return f"{cell.days} {timedelta(seconds=cell.seconds, microseconds=cell.microseconds)}"
    return cell.isoformat() if isinstance(cell, datetime | date | time) else str(cell)
