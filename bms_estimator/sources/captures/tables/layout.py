"""Layout of a table: the columns of a sample, their units and the kind of their cells; and the samples of its rows."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Literal, NamedTuple, get_args

import numpy as np

from bms_estimator.model.arrays import (
    MAX_C,
    MIN_C,
    NO_CELLS,
    SAMPLE,
    CellBlock,
    Floats,
    SampleBlock,
    remove_implausible,
)
from bms_estimator.sources.captures.tables.cell_values import (
    SI_UNITS,
    CellKind,
    Quantity,
    Unit,
    parser,
    time_kind,
)
from bms_estimator.sources.captures.tables.dialects import Dialect

QUANTITIES: tuple[Quantity, ...] = get_args(Quantity)
REQUIRED: tuple[Quantity, ...] = ("time", "current", "voltage")
"""Quantities that a table must have."""
SHEET: Literal["sheet"] = "sheet"
"""Key of the sheet of a spreadsheet in a ``ColumnMap``."""
INSTANCE: Literal["instance"] = "instance"
"""Key of the number of the battery in a ``ColumnMap``."""
BLOCK_ROWS = 65_536
"""Maximum number of rows of a block."""

ColumnMap = Mapping[Quantity | Literal["sheet", "instance"], str]
"""Column names that the user gave, by quantity; also the name of the sheet and the number of the battery."""


class Role(Enum):
    """Meaning of a column: a ``Quantity``, the sign of the current (state, charge current), a second time, status, or battery."""

    TIME = "time"
    CURRENT = "current"
    VOLTAGE = "voltage"
    TEMPERATURE = "temperature"
    TEMPERATURE_MIN = "lowest temperature"
    TEMPERATURE_MAX = "highest temperature"
    STATE = "state"
    CLOCK = "second time"
    CHARGE_CURRENT = "charge current"
    STATUS = "status"
    INSTANCE = "battery"
    SERIES = "cells in series"


class CellVoltage(NamedTuple):
    """Meaning of a column with the voltage of a single cell."""

    number: int
    """Number of the cell, from 1."""

    @property
    def value(self) -> str:
        """Name of the quantity."""
        return f"cell {self.number}"


ColumnRole = Role | CellVoltage
TIME_ROLES = (Role.TIME, Role.CLOCK)
"""Roles of columns with a time."""
RawBlock = dict[ColumnRole, Floats]
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
        is_lenient: True if an invalid cell is a missing value.
    """

    index: int
    name: str
    unit: Unit
    assumed: bool = False
    kind: CellKind = CellKind.NUMBER
    is_lenient: bool = False

    def parser(self, *, decimal_comma: bool) -> Callable[[str], float]:
        """Return the function that converts the cells; it raises ValueError or OverflowError unless ``is_lenient`` is set."""
        parse = parser(self.kind, decimal_comma=decimal_comma)
        if not self.is_lenient:
            return parse

        def parse_leniently(cell: str) -> float:
            try:
                return parse(cell)
            except (ValueError, OverflowError):
                return np.nan

        return parse_leniently


@dataclass(frozen=True)
class Layout:
    """Columns of a sample in a table.

    Attributes:
        dialect: Dialect of the table.
        columns: The columns by role.
        has_given_columns: True if the user named columns.
    """

    dialect: Dialect
    columns: Mapping[ColumnRole, Column]
    has_given_columns: bool = False

    @property
    def cells(self) -> tuple[CellVoltage, ...]:
        """Cells with a voltage column, in order."""
        return tuple(role for role in self.columns if isinstance(role, CellVoltage))


def with_time_kinds(layout: Layout, cells_of: Callable[[Column], Iterable[str]]) -> Layout:
    """Return the layout with the kinds of its time columns.

    Args:
        layout: Columns of the table.
        cells_of: Function that returns the cells of a column.
    """
    kinds = {role: time_kind(cells_of(layout.columns[role])) for role in TIME_ROLES if role in layout.columns}
    return with_column_kinds(layout, kinds)


def with_column_kinds(layout: Layout, kinds: Mapping[Role, CellKind]) -> Layout:
    """Return the layout with other kinds of its time columns. Durations and time stamps are in seconds."""
    columns = dict(layout.columns)
    for role, kind in kinds.items():
        if kind is not CellKind.NUMBER:
            columns[role] = dataclasses.replace(columns[role], kind=kind, unit=SI_UNITS["time"], assumed=False)
    return dataclasses.replace(layout, columns=columns)


def without_clock(layout: Layout) -> Layout:
    """Return the layout without its second time column."""
    columns = dict(layout.columns)
    columns.pop(Role.CLOCK, None)
    return dataclasses.replace(layout, columns=columns)


def to_samples(raw: RawBlock, layout: Layout) -> SampleBlock:
    """Return samples in SI units. The current has the sign of the table."""
    with np.errstate(over="ignore"):  # infinite results are dropped like other invalid values
        values = {role: raw[role] * column.unit.factor + column.unit.offset for role, column in layout.columns.items()}
    samples = np.zeros(values[Role.TIME].size, dtype=SAMPLE)
    samples["time_s"], samples["voltage_v"] = values[Role.TIME] + values.get(Role.CLOCK, 0.0), values[Role.VOLTAGE]
    samples["current_a"] = values[Role.CURRENT]
    if Role.CHARGE_CURRENT in values:
        discharge_a, charge_a = np.abs(values[Role.CURRENT]), np.abs(values[Role.CHARGE_CURRENT])
        samples["current_a"] = np.nan_to_num(discharge_a) - np.nan_to_num(charge_a)
    samples["temperature_c"] = values.get(Role.TEMPERATURE, np.nan)
    samples["temperature_min_c"] = values.get(Role.TEMPERATURE_MIN, samples["temperature_c"])
    samples["temperature_max_c"] = values.get(Role.TEMPERATURE_MAX, samples["temperature_c"])
    if Role.STATUS in values:
        samples["status"] = np.nan_to_num(values[Role.STATUS]).clip(0.0, np.iinfo(np.uint32).max)
    return samples


def remove_implausible_temperatures(samples: SampleBlock) -> int:
    """Replace implausible temperatures with NaN in place; return the number of samples with an implausible ``temperature_c``."""
    for name in ("temperature_min_c", "temperature_max_c"):
        remove_implausible(samples[name], MIN_C, MAX_C)
    return remove_implausible(samples["temperature_c"], MIN_C, MAX_C)


def cell_voltages(raw: RawBlock, layout: Layout) -> CellBlock:
    """Return the cell voltages of a block, shape (n, m) [V]; empty for a table without them."""
    cells = layout.cells
    return np.column_stack([raw[cell] for cell in cells]) if cells else NO_CELLS
