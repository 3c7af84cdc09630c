"""Layout of a table: the columns of a sample, their units and the kind of their cells."""

import dataclasses
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from bms_estimator.model.cell_voltage_columns import present_columns
from bms_estimator.model.errors import UserError
from bms_estimator.model.sample import SAMPLE
from bms_estimator.sources.captures.tables.cell_values import CellKind
from bms_estimator.sources.captures.tables.dialects import DIALECTS, GENERIC, OWN, Dialect
from bms_estimator.sources.captures.tables.units import (
    SI_UNITS,
    ColumnName,
    Quantity,
    Unit,
    find_unit,
    fold,
    split_unit,
)

QUANTITIES: tuple[Quantity, ...] = get_args(Quantity)
REQUIRED: tuple[Quantity, ...] = ("time", "current", "voltage")
"""Quantities that a table must have."""
SHEET: Literal["sheet"] = "sheet"
"""Key of the sheet of a spreadsheet in a ``ColumnMap``."""
MAP_SYNTAX = "time=COLUMN,current=COLUMN,voltage=COLUMN[,temperature=COLUMN][,sheet=SHEET]"
MAP_HELP = f"--map {MAP_SYNTAX} (in Python: column_map)"
MAX_SHOWN_COLUMNS = 30
"""Maximum number of column names in a message."""
MAX_SHOWN_CHARACTERS = 40
"""Maximum length of a column name in a message."""

DISCHARGE_CURRENTS = frozenset(fold(name) for name in ("discharge current", "entladestrom"))
"""Names of a column that contains only the discharge current. The charge current has another column."""
BLOCK_ROWS = 65_536
"""Maximum number of rows of a block."""

ColumnMap = Mapping[Quantity | Literal["sheet"], str]
"""Column names that the user gave, by quantity, and the name of the sheet."""


class Role(Enum):
    """Meaning of a column: a ``Quantity``, the sign of the current (state, charge current), or the status bits of a sample."""

    TIME = "time"
    CURRENT = "current"
    VOLTAGE = "voltage"
    TEMPERATURE = "temperature"
    TEMPERATURE_MIN = "lowest temperature"
    TEMPERATURE_MAX = "highest temperature"
    STATE = "state"
    CHARGE_CURRENT = "charge current"
    STATUS = "status"


class CellVoltage(NamedTuple):
    """Meaning of a column with the voltage of a single cell."""

    number: int
    """Number of the cell, from 1."""

    @property
    def value(self) -> str:
        """Name of the quantity."""
        return f"cell {self.number}"


ColumnRole = Role | CellVoltage
RawBlock = dict[ColumnRole, NDArray[np.float64]]
"""Columns of a block of rows, in the units of the table."""


@dataclass(frozen=True)
class Column:
    """Column of a sample in a table.

    Attributes:
        index: Index of the column.
        name: Name as in the table.
        unit: Unit of the numbers.
        assumed: True if the table does not state the unit.
        kind: Kind of the cells.
    """

    index: int
    name: str
    unit: Unit
    assumed: bool = False
    kind: CellKind = CellKind.NUMBER


@dataclass(frozen=True)
class Layout:
    """Columns of a sample in a table.

    Attributes:
        dialect: Dialect of the table; None if the user named the columns.
        columns: The columns by role.
    """

    dialect: Dialect | None
    columns: Mapping[ColumnRole, Column]

    @property
    def cells(self) -> tuple[CellVoltage, ...]:
        """Cells with a voltage column, in order."""
        return tuple(role for role in self.columns if isinstance(role, CellVoltage))


class LayoutFinder:
    """Finder of the columns of a sample in a header.

    Args:
        path: Name of the table for messages.
        column_map: Column names and sheet that the user gave; without columns the dialect is recognized.

    Attributes:
        sheet: Name of the sheet that the user gave; None: the sheet is recognized.
    """

    def __init__(self, path: object, column_map: ColumnMap | None = None) -> None:
        given = column_map or {}
        self._path, self.sheet = path, given.get(SHEET)
        self._map: dict[Quantity, str] = {quantity: given[quantity] for quantity in QUANTITIES if quantity in given}
        self._closest_header: Sequence[str] = ()
        self._closest_rank = (0, 0)

    def find(self, header: Sequence[str]) -> Layout | None:
        """Return the layout of a table with this header; None if it is not a header.

        Raises:
            UserError: Several columns have the same name, or the unit of a column is not known.
        """
        if self._map:
            return self._apply_map(header)
        names = [split_unit(cell) for cell in header]
        for dialect in DIALECTS:
            if dialect.matches(header, names) and (layout := self._apply_dialect(dialect, header, names)):
                return layout
        rank = (len(REQUIRED) - len(_missing(names)), len(header))
        if rank > self._closest_rank:
            self._closest_header, self._closest_rank = header, rank
        return None

    def no_header(self) -> UserError:
        """Return the error for a table without a header. It names the columns of the line that is most similar to a header."""
        if self._map:
            return UserError(f"{self._path}: no line names the columns {', '.join(self._map.values())}")
        header, (found, width) = self._closest_header, self._closest_rank
        needed = f"{','.join(OWN.signatures[0])}[,temperature_c], the columns of a program in docs/cell/captures.md, or {MAP_HELP}"
        if not found or width < len(REQUIRED) - 1:  # a line of text may contain a name by chance
            return UserError(f"{self._path}: not a capture: no line names the columns; needed: {needed}")
        missing = " nor ".join(_missing([split_unit(cell) for cell in header]))
        columns = ", ".join(cell.strip()[:MAX_SHOWN_CHARACTERS] for cell in header[:MAX_SHOWN_COLUMNS])
        return UserError(f"{self._path}: no column of {missing}; found {columns}; needed: {needed}")

    def _apply_map(self, header: Sequence[str]) -> Layout | None:
        """Return the layout with the columns that the user named; None if the header lacks one of them."""
        cells = [cell.strip() for cell in header]
        if not set(self._map.values()) <= set(cells):
            return None
        columns = dict[ColumnRole, Column]()
        for quantity, name in self._map.items():
            if cells.count(name) > 1:
                raise UserError(f"{self._path}: {cells.count(name)} columns are named {name}: rename all but one")
            columns[Role(quantity)] = self._column(quantity, cells.index(name), cells, split_unit(name))
        return Layout(None, columns)

    def _apply_dialect(self, dialect: Dialect, header: Sequence[str], names: Sequence[ColumnName]) -> Layout | None:
        """Return the layout of a dialect; None if the header lacks a required column."""
        cells = [cell.strip() for cell in header]
        columns = dict[ColumnRole, Column]()
        for quantity in QUANTITIES:
            index = self._find_index(getattr(dialect, quantity), cells, names)
            if index is not None:
                columns[Role(quantity)] = self._column(quantity, index, cells, names[index])
            elif quantity in REQUIRED:
                return None
        if dialect is OWN:
            columns |= _own_columns(cells)
        current_name = names[columns[Role.CURRENT].index].name
        return Layout(dialect, columns | self._sign_columns(dialect, cells, names, current_name))

    def _sign_columns(
        self, dialect: Dialect, cells: Sequence[str], names: Sequence[ColumnName], current_name: str
    ) -> dict[ColumnRole, Column]:
        """Return the optional columns that determine the sign of the current."""
        columns = dict[ColumnRole, Column]()
        state = self._find_index(dialect.state, cells, names)
        if state is not None:
            columns[Role.STATE] = Column(state, cells[state], Unit(""), kind=CellKind.DIRECTION)
        charge = self._find_index(dialect.charge_current, cells, names)
        if charge is not None and current_name in DISCHARGE_CURRENTS:
            columns[Role.CHARGE_CURRENT] = self._column("current", charge, cells, names[charge])
        return columns

    def _find_index(self, wanted: Sequence[str], cells: Sequence[str], names: Sequence[ColumnName]) -> int | None:
        """Return the index of the first of the wanted names that a header has.

        Raises:
            UserError: Several columns have this name.
        """
        for name in wanted:
            indices = [index for index, column in enumerate(names) if column.name == fold(name)]
            if len(indices) > 1:
                columns = " and ".join(cells[index] for index in indices)
                raise UserError(f"{self._path}: {columns}: choose one of these columns by {MAP_HELP}")
            if indices:
                return indices[0]
        return None

    def _column(self, quantity: Quantity, index: int, cells: Sequence[str], name: ColumnName) -> Column:
        if name.unit is None:
            return Column(index, cells[index], SI_UNITS[quantity], assumed=True)
        unit = find_unit(quantity, name.unit)
        if unit is None:
            raise UserError(
                f"{self._path}: column {cells[index]}: {name.unit!r} is not a unit of {quantity} that is supported; "
                f"convert it, or name other columns by {MAP_HELP}"
            )
        return Column(index, cells[index], unit)


def _own_columns(header: Sequence[str]) -> dict[ColumnRole, Column]:
    """Return the columns that only tables of this project have: cell voltages, extremes of the temperature probes and the status.

    ``fleet capture`` writes exactly the columns of a sample and of the cells; the status of another table has another meaning.
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


def with_units(layout: Layout, units_row: Sequence[str]) -> Layout | None:
    """Return the layout with the units in the row below the header; None if the row does not contain units."""
    if len(units_row) <= max(column.index for column in layout.columns.values()):
        return None
    columns = dict(layout.columns)
    for quantity in QUANTITIES:
        column = columns.get(Role(quantity))
        if column is None:
            continue
        unit = find_unit(quantity, units_row[column.index])
        if unit is None:
            return None
        columns[Role(quantity)] = dataclasses.replace(column, unit=unit, assumed=False)
    return dataclasses.replace(layout, columns=columns)


def with_time_kind(layout: Layout, kind: CellKind) -> Layout:
    """Return the layout with the kind of its time column replaced. Durations and time stamps are in seconds."""
    time = layout.columns[Role.TIME]
    unit = time.unit if kind is CellKind.NUMBER else SI_UNITS["time"]
    column = dataclasses.replace(time, kind=kind, unit=unit, assumed=time.assumed and kind is CellKind.NUMBER)
    return dataclasses.replace(layout, columns={**layout.columns, Role.TIME: column})


def parse_column_map(text: str) -> ColumnMap:
    """Parse ``MAP_SYNTAX``, or ``sheet=SHEET`` alone. Names may contain commas.

    Raises:
        UserError: A quantity is missing, unknown or given twice.
    """
    keys = (*QUANTITIES, SHEET)
    parts = re.split(rf",(?=(?:{'|'.join(keys)})=)", text)
    pairs = [tuple(part.partition("=")[::2]) for part in parts]
    names = dict(pairs)
    is_complete = set(REQUIRED) <= set(names) or set(names) == {SHEET}
    if len(names) < len(pairs) or not is_complete or not set(names) <= set(keys) or not all(names.values()):
        raise UserError(f"--map {text}: must be {MAP_SYNTAX}")
    return {key: names[key].strip() for key in keys if key in names}


def _missing(names: Sequence[ColumnName]) -> list[Quantity]:
    """Return the required quantities for which a header has no column of a usual name."""
    present = {column.name for column in names}
    return [quantity for quantity in REQUIRED if not present & {fold(name) for name in getattr(GENERIC, quantity)}]
