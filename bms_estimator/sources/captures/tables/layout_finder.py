"""Finder of the columns of a sample in the header of a table, by the names that the user gave and those of the dialects."""

import dataclasses
import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from bms_estimator.model.arrays import SAMPLE
from bms_estimator.model.columns import present_columns
from bms_estimator.model.decimal_text import number
from bms_estimator.model.errors import UserError
from bms_estimator.sources.captures.tables.cell_values import (
    SI_UNITS,
    CellKind,
    ColumnName,
    Quantity,
    Unit,
    find_unit,
    fold,
    parse_number,
    split_unit,
)
from bms_estimator.sources.captures.tables.dialects import CLOCKS, DIALECTS, DISCHARGE_CURRENTS, GENERIC, OWN, Dialect
from bms_estimator.sources.captures.tables.layout import (
    INSTANCE,
    QUANTITIES,
    REQUIRED,
    SHEET,
    CellVoltage,
    Column,
    ColumnMap,
    ColumnRole,
    Layout,
    Role,
)

MAP_SYNTAX = "one or more of time=COLUMN,current=COLUMN,voltage=COLUMN,temperature=COLUMN,sheet=SHEET,instance=NUMBER"
MAP_HELP = "--map time=COLUMN,current=COLUMN,voltage=COLUMN (in Python: column_map)"
MAX_SHOWN_COLUMNS = 30
"""Maximum number of column names in a message."""
MAX_SHOWN_CHARACTERS = 40
"""Maximum length of a column name in a message."""


class _Header(NamedTuple):
    """Line that may be a header, with the required quantities for which a dialect has no column in it."""

    cells: Sequence[str]
    dialect: Dialect
    missing: Sequence[Quantity]

    def rank(self) -> tuple[int, int]:
        """Return the similarity to a header: number of quantities found, then number of columns."""
        return -len(self.missing), len(self.cells)


class LayoutFinder:
    """Finder of the columns of a sample in a header.

    Args:
        path: Name of the table for messages.
        column_map: Column names and sheet that the user gave. The dialect determines the other columns.

    Attributes:
        given: Column names that the user gave, by quantity.
        sheet: Name of the sheet that the user gave; None: the sheet is recognized.
        instance: Number of the battery that the user gave; None: the table must have rows of one battery only.

    Raises:
        UserError: The number of the battery is not a number.
    """

    def __init__(self, path: object, column_map: ColumnMap | None = None) -> None:
        given = column_map or {}
        self._path, self.sheet = path, given.get(SHEET)
        try:
            self.instance = number(given[INSTANCE]) if INSTANCE in given else None
        except ValueError:
            raise UserError(f"{path}: --map instance={given[INSTANCE]}: must be a number") from None
        self.given: dict[Quantity, str] = {quantity: given[quantity] for quantity in QUANTITIES if quantity in given}
        self._closest = _Header((), GENERIC, REQUIRED)
        self._first_numbers: Sequence[str] = ()
        self._names: Sequence[str] = ()  # cells of the last line above the first numbers

    def find(self, header: Sequence[str]) -> Layout | None:
        """Return the layout of a table with this header; None if it is not a header.

        Raises:
            UserError: Several columns have the same name, or the unit of a column is not known.
        """
        cells = [cell.strip() for cell in header]
        given = self._given_columns(cells)
        if len(given) < len(self.given):
            return None
        names = [split_unit(cell) for cell in cells]
        for dialect in DIALECTS:
            if not dialect.matches(cells, names):
                continue
            missing = [q for q in REQUIRED if q not in given and not _find_indices(getattr(dialect, q), names)]
            if not missing:
                return self._apply_dialect(dialect, cells, names, given)
            self._closest = max(self._closest, _Header(cells, dialect, missing), key=_Header.rank)
        numbers = sum(map(_is_number, cells))
        if not self._first_numbers and not numbers and len(cells) >= len(REQUIRED):
            self._names = cells
        if not self._first_numbers and numbers >= max(len(REQUIRED), 0.5 * len(cells)):
            self._first_numbers = cells
        return None

    def no_header_error(self) -> UserError:
        """Return the error for a table without a header. It names the columns of the line that is most similar to a header."""
        header, dialect, missing = self._closest
        if self.given and not header:
            return UserError(f"{self._path}: no line names the columns {', '.join(self.given.values())}")
        needed = f"{','.join(OWN.signatures[0])}[,temperature_c], the columns of a program in docs/cell/captures.md, or {MAP_HELP}"
        if (
            len(missing) == len(REQUIRED) or len(header) < len(REQUIRED) - 1
        ):  # a line of text may contain a name by chance
            if self._first_numbers and len(self._names) == len(self._first_numbers):
                return UserError(
                    f"{self._path}: the columns {shorten_cells(self._names)} have none of the known names: name them by {MAP_HELP}"
                )
            if self._first_numbers:
                return UserError(
                    f"{self._path}: no line names the columns: add one above {shorten_cells(self._first_numbers)}, with a name for each "
                    f"of the {len(self._first_numbers)} columns, such as {','.join(OWN.signatures[0])}; columns that are not "
                    "needed may have any other names"
                )
            return UserError(f"{self._path}: not a capture: no line names the columns; needed: {needed}")
        program = "" if dialect is GENERIC else f" in this export of {dialect.name}"
        return UserError(
            f"{self._path}: no column of {' nor '.join(missing)}{program}; found {shorten_cells(header)}; needed: {needed}"
        )

    def with_units(self, layout: Layout, units_row: Sequence[str]) -> Layout | None:
        """Return the layout with the units in the row below the header; None if the row does not contain units.

        A column with an empty cell keeps its unit.

        Raises:
            UserError: The unit of a required column is not known.
        """
        columns, is_units_row = dict(layout.columns), False
        for quantity in QUANTITIES:
            column = columns.get(Role(quantity))
            text = units_row[column.index].strip() if column and column.index < len(units_row) else ""
            if column is None or not text:
                continue
            is_units_row |= find_unit(quantity, text) is not None
            if not is_units_row:
                return None
            if with_unit := self._column(quantity, column.index, column.name, text):
                columns[Role(quantity)] = with_unit
            else:
                del columns[Role(quantity)]
        return dataclasses.replace(layout, columns=columns) if is_units_row else None

    def _given_columns(self, cells: Sequence[str]) -> dict[Quantity, Column]:
        """Return the columns that the user named and the header has. A name may be followed by a unit in square brackets."""
        columns = dict[Quantity, Column]()
        for quantity, given in self.given.items():
            name, unit = (given, None) if given in cells else split_given_unit(given)
            if cells.count(name) > 1:
                raise UserError(f"{self._path}: {cells.count(name)} columns are named {name}: rename all but one")
            if name not in cells:
                continue
            if column := self._column(quantity, cells.index(name), name, unit or split_unit(name).unit):
                columns[quantity] = column
        return columns

    def _apply_dialect(
        self, dialect: Dialect, cells: Sequence[str], names: Sequence[ColumnName], given: Mapping[Quantity, Column]
    ) -> Layout:
        """Return the layout of a dialect with the given columns, for a header with all required columns."""
        columns = dict[ColumnRole, Column]()
        for quantity in QUANTITIES:
            indices = _find_indices(getattr(dialect, quantity), names)
            if quantity in given:
                columns[Role(quantity)] = given[quantity]
            elif len(indices) > 1 and quantity in REQUIRED:
                several = " and ".join(cells[index] for index in indices)
                raise UserError(f"{self._path}: {several}: choose one of these columns by {MAP_HELP}")
            elif indices:
                unit = names[indices[0]].unit or (dialect.time_unit if quantity == "time" else None)
                if column := self._column(quantity, indices[0], cells[indices[0]], unit):
                    columns[Role(quantity)] = column
        columns |= _own_columns(cells) if dialect is OWN else _clock_column(dialect, cells, names, columns[Role.TIME])
        current_name = names[columns[Role.CURRENT].index].name
        return Layout(dialect, columns | self._optional_columns(dialect, cells, names, current_name), bool(given))

    def _optional_columns(
        self, dialect: Dialect, cells: Sequence[str], names: Sequence[ColumnName], current_name: str
    ) -> dict[ColumnRole, Column]:
        """Return the optional columns of the battery and those that determine the sign of the current."""
        columns = dict[ColumnRole, Column]()
        for role, wanted in ((Role.INSTANCE, dialect.instance), (Role.SERIES, dialect.series)):
            for index in _find_indices(wanted, names)[:1]:
                kind = CellKind.LABEL if role is Role.INSTANCE else CellKind.NUMBER
                columns[role] = Column(index, cells[index], Unit(""), kind=kind, is_lenient=True)
        for state in _find_indices(dialect.state, names)[:1]:
            columns[Role.STATE] = Column(state, cells[state], Unit(""), kind=CellKind.DIRECTION)
        if current_name in map(fold, DISCHARGE_CURRENTS):
            for charge in _find_indices(dialect.charge_current, names)[:1]:
                if column := self._column("current", charge, cells[charge], names[charge].unit):
                    columns[Role.CHARGE_CURRENT] = column
        return columns

    def _column(self, quantity: Quantity, index: int, name: str, unit_text: str | None) -> Column | None:
        """Return a column with its unit; None if an optional column that the user did not name has an unknown unit.

        Raises:
            UserError: The unit of another column is not known.
        """
        if unit_text is None:
            return Column(index, name, SI_UNITS[quantity], assumed=True)
        unit = find_unit(quantity, unit_text)
        if unit is None and (quantity in REQUIRED or quantity in self.given):
            raise UserError(
                f"{self._path}: column {name}: {unit_text!r} is not a unit of {quantity} that is supported; "
                f"convert it, or name other columns by {MAP_HELP}"
            )
        return unit and Column(index, name, unit)


def _find_indices(wanted: Sequence[str], names: Sequence[ColumnName]) -> list[int]:
    """Return the indices of the columns with the first of the wanted names that a header has; an empty list if it has none."""
    found = (
        [index for index, column in enumerate(names) if fold(name) in (column.name, column.full_name)]
        for name in wanted
    )
    return next(filter(None, found), [])


def split_given_unit(given: str) -> tuple[str, str | None]:
    """Return the name and the unit of a column that a user gave as ``name [unit]``."""
    name, bracket, unit = given.rpartition(" [")
    return (name, unit.removesuffix("]")) if bracket else (given, None)


def _own_columns(header: Sequence[str]) -> dict[ColumnRole, Column]:
    """Return the columns that only tables of this project have: cell voltages, extremes of the temperature probes and the status.

    The status is read only if the table has exactly the columns that ``fleet capture`` writes. Elsewhere it has another meaning.
    """
    cells = present_columns(header)
    columns: dict[ColumnRole, Column] = {
        CellVoltage(number): Column(header.index(name), name, SI_UNITS["voltage"])
        for number, name in enumerate(cells, 1)
    }
    extremes = {Role.TEMPERATURE_MIN: "temperature_min_c", Role.TEMPERATURE_MAX: "temperature_max_c"}
    if {"temperature_c", *extremes.values()} <= {*header}:
        columns |= {role: Column(header.index(name), name, SI_UNITS["temperature"]) for role, name in extremes.items()}
    if ({*header} - {*cells}) | {*extremes.values()} == {*(SAMPLE.names or ())}:
        columns[Role.STATUS] = Column(header.index("status"), "status", Unit(""))
    return columns


def _clock_column(
    dialect: Dialect, cells: Sequence[str], names: Sequence[ColumnName], time: Column
) -> dict[ColumnRole, Column]:
    """Return the second time column, if a table has one whose unit is known."""
    wanted = [name for name in (*dialect.time, *CLOCKS) if fold(name) != names[time.index].name]
    for index in _find_indices(wanted, names)[:1]:
        unit = find_unit("time", names[index].unit or "s")
        if unit is not None:
            return {Role.CLOCK: Column(index, cells[index], unit, assumed=names[index].unit is None, is_lenient=True)}
    return {}


def parse_column_map(text: str) -> ColumnMap:
    """Parse ``MAP_SYNTAX``. Names may contain commas.

    Raises:
        UserError: A quantity is unknown, is given twice, or has no column.
    """
    keys = (*QUANTITIES, SHEET, INSTANCE)
    parts = re.split(rf",(?=(?:{'|'.join(keys)})=)", text)
    pairs = [tuple(part.partition("=")[::2]) for part in parts]
    names = dict(pairs)
    if len(names) < len(pairs) or not set(names) <= set(keys) or not all(names.values()):
        raise UserError(f"--map {text}: must be {MAP_SYNTAX}")
    return {key: names[key].strip() for key in keys if key in names}


def _is_number(cell: str) -> bool:
    try:
        return bool(np.isfinite(parse_number(cell, decimal_comma=False)))
    except (ValueError, OverflowError):
        return False


def shorten_cells(cells: Sequence[str]) -> str:
    """Return cells of a line for messages, limited in number and length."""
    return ", ".join(cell[:MAX_SHOWN_CHARACTERS] for cell in cells[:MAX_SHOWN_COLUMNS])
