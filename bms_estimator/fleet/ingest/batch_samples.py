"""Samples of a telemetry batch: units, sign of the current, timestamps and order. No I/O."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from types import NoneType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bms_estimator.edge.cell_voltages import MAX_CELLS
from bms_estimator.fleet.worker.block_order import MAX_AHEAD_S
from bms_estimator.model.arrays import (
    MAX_CELL_V,
    MIN_CELL_V,
    NO_CELLS,
    CellBlock,
    CurrentSign,
    SampleBlock,
    remove_implausible,
)
from bms_estimator.model.clock import iso_utc
from bms_estimator.model.errors import UserError
from bms_estimator.sources.captures.tables.cell_values import DATES, CellKind, Unit, date_order, find_unit, split_unit
from bms_estimator.sources.captures.tables.column_tables import parse_column
from bms_estimator.sources.captures.tables.layout import (
    Column,
    ColumnMap,
    ColumnRole,
    Layout,
    Role,
    cell_voltages,
    remove_implausible_temperatures,
    to_samples,
    with_column_kinds,
)
from bms_estimator.sources.captures.tables.layout_finder import LayoutFinder

Values = Sequence[Any] | NDArray[Any]
"""Values of a column: numbers, texts, ``datetime64`` timestamps, or one list of cell voltages for each row."""
BatchColumns = Mapping[str, Values]
"""Columns of equal length by name."""

MAX_VALUES = 1 << 20
"""Maximum number of values in a batch. An uncompressed message of 1 MiB cannot hold more numbers of one byte each."""
MIN_TIME_S = 946_684_800.0
"""Earliest plausible timestamp: 2000-01-01 [s since 1970]."""
MAX_LAYOUTS = 256
"""Maximum number of headers whose layout is cached."""
MAX_COLUMNS = 4096
"""Maximum number of columns. Other tasks wait while columns are recognized, 70 ms for this number."""
MAX_CACHED_COLUMNS, MAX_CACHED_CHARACTERS = 400, 8000
"""Maximum size of a header whose layout is cached. With ``MAX_LAYOUTS`` headers of this size the cache has about 16 MB."""
CELLS = "cells"
"""Name, without its unit, of the column with a list of cell voltages in each row. Alternatively, each cell has a column
``cell_1_v``, ``cell_2_v`` and so on."""
_TABLE_NAME = "the batch"
"""Name of a batch in the errors of ``LayoutFinder``; removed from them."""
_NUMBERS = {int, float, NoneType}


class BatchError(ValueError):
    """Error in a batch, with the reason."""


def check_count(values: int) -> None:
    """Check the number of values of a batch, before memory for them is allocated.

    Raises:
        BatchError: The number exceeds ``MAX_VALUES``.
    """
    if values > MAX_VALUES:
        raise BatchError(f"{values:,} values: must be at most {MAX_VALUES:,}; send smaller batches")


class BatchSamples(NamedTuple):
    """Samples of a batch, with times in seconds since 1970 and the current positive on discharge."""

    samples: SampleBlock
    cells_v: CellBlock
    """Shape (n, m) [V]; empty without cell voltages."""


class Selection(NamedTuple):
    """New samples of a batch in order of time, and the numbers of dropped samples."""

    samples: SampleBlock
    cells_v: CellBlock
    old: int
    """Number of samples at or before the pack's last sample, and of repeated times within the batch."""
    implausible: int
    """Number of samples without a time, or with a time before 2000 or in the future."""


class BatchReader:
    """Converter of columns to samples.

    Args:
        column_map: Configured names of columns; None: the columns are recognized.
        current_sign: Direction of positive current in the batches; None: that of a recognized format, or else positive on
            discharge.
    """

    def __init__(self, column_map: ColumnMap | None = None, current_sign: CurrentSign | None = None) -> None:
        self._column_map, self._current_sign = column_map, current_sign
        self._find_cached = lru_cache(MAX_LAYOUTS)(self._find)

    def read(self, columns: BatchColumns) -> BatchSamples:
        """Return the samples of a batch, in the order of the batch.

        Raises:
            BatchError: A column is missing, or a value is invalid. The message names column and row.
        """
        try:
            layout, cells = self._find_layout(tuple(columns))
            layout = with_column_kinds(layout, {Role.TIME: _time_kind(columns[layout.columns[Role.TIME].name])})
            raw = {role: _floats(column, columns[column.name]) for role, column in layout.columns.items()}
            if cells:
                cells_v = _listed_cell_voltages(cells.name, columns[cells.name], cells.unit)
            else:
                cells_v = cell_voltages(raw, layout)
                remove_implausible(cells_v, MIN_CELL_V, MAX_CELL_V)
        except UserError as error:
            raise BatchError(_reason(error)) from None
        except OverflowError:
            raise BatchError("a number is too large") from None
        samples = to_samples(raw, layout)
        if (self._current_sign or layout.dialect.current_sign) == "charge_positive":
            samples["current_a"] *= -1.0
        remove_implausible_temperatures(samples)
        return BatchSamples(samples, cells_v)

    def used_columns(self, names: Sequence[str]) -> list[Column]:
        """Return the columns that ``read`` uses. The time column is the first.

        Raises:
            BatchError: A column is missing.
        """
        try:
            layout, cells = self._find_layout(tuple(names))
        except UserError as error:
            raise BatchError(_reason(error)) from None
        others = [column for role, column in layout.columns.items() if role is not Role.TIME]
        return [layout.columns[Role.TIME], *others, *([cells] if cells else [])]

    def _find_layout(self, header: tuple[str, ...]) -> tuple[Layout, Column | None]:
        if len(header) > MAX_COLUMNS:
            raise UserError(f"{len(header):,} columns: must be at most {MAX_COLUMNS:,}")
        is_small = len(header) <= MAX_CACHED_COLUMNS and sum(map(len, header)) <= MAX_CACHED_CHARACTERS
        return (self._find_cached if is_small else self._find)(header)

    def _find(self, header: tuple[str, ...]) -> tuple[Layout, Column | None]:
        """Return the columns of a sample, and the column of cell voltages.

        Raises:
            UserError: A column is missing.
        """
        finder = LayoutFinder(_TABLE_NAME, self._column_map)
        layout = finder.find(header)
        if layout is None:
            raise finder.no_header_error()
        roles: dict[ColumnRole, Column] = {
            role: Column(column.index, header[column.index], column.unit, column.assumed)
            for role, column in layout.columns.items()
            if role not in (Role.STATE, Role.CLOCK, Role.INSTANCE, Role.SERIES)
        }
        if len(layout.cells) > MAX_CELLS:
            raise UserError(f"{len(layout.cells)} columns of cell voltages: must be at most {MAX_CELLS}")
        cells = [name for name in header if split_unit(name).name == CELLS]
        if not cells:
            return Layout(layout.dialect, roles), None
        unit = find_unit("voltage", split_unit(cells[0]).unit or "V")
        if unit is None or len(cells) > 1:
            raise UserError(f"column {', '.join(cells)}: must be one column cells_v or cells_mv")
        return Layout(layout.dialect, roles), Column(header.index(cells[0]), cells[0], unit)


def _reason(error: UserError) -> str:
    return str(error).removeprefix(f"{_TABLE_NAME}: ")


def select_new(batch: BatchSamples, last_s: float, now_s: float) -> Selection:
    """Return the samples of a batch after the pack's last sample, in order of time and each time once.

    Args:
        batch: Samples of the batch.
        last_s: Time of the pack's last sample [s since 1970]; minus infinity without one.
        now_s: Time of arrival of the batch [s since 1970].
    """
    times: NDArray[np.float64] = batch.samples["time_s"]
    plausible = (times >= MIN_TIME_S) & (times <= now_s + MAX_AHEAD_S)
    order = np.flatnonzero(plausible)
    order = order[np.argsort(times[order], kind="stable")]
    is_new = np.diff(times[order], prepend=last_s) > 0.0
    is_new &= times[order] > last_s
    new_rows = order[is_new]
    cells_v = batch.cells_v[new_rows] if batch.cells_v.size else NO_CELLS
    implausible = times.size - order.size
    return Selection(batch.samples[new_rows], cells_v, order.size - new_rows.size, implausible)


def drop_reason(old: int, implausible: int, last_s: float) -> str:
    """Return the reason for which samples were dropped; empty if none was.

    Args:
        old: ``Selection.old``.
        implausible: ``Selection.implausible``.
        last_s: Time of the pack's last sample before the batch [s since 1970].
    """
    reasons = []
    if old:
        end = f"the pack's last stored time {iso_utc(last_s)}" if np.isfinite(last_s) else "an equal time"
        reasons.append(f"{old} samples at or before {end}: sent again, or too late")
    if implausible:
        reasons.append(
            f"{implausible} samples without a time, or with one before 2000 or in the future; "
            "name a column of milliseconds time_ms"
        )
    return "; ".join(reasons)


def split_by_time(batch: BatchSamples, max_samples: int) -> Iterator[BatchSamples]:
    """Yield the samples of a batch in parts of at most ``max_samples``, in order of time if there are several."""
    if batch.samples.size <= max_samples:
        yield batch
        return
    order = np.argsort(batch.samples["time_s"], kind="stable")
    for first in range(0, order.size, max_samples):
        part = order[first : first + max_samples]
        yield BatchSamples(batch.samples[part], batch.cells_v[part] if batch.cells_v.size else NO_CELLS)


def _time_kind(values: Values) -> CellKind:
    if isinstance(values, np.ndarray):
        return CellKind.DATE_TIME if values.dtype.kind == "M" else CellKind.NUMBER
    first = next((value for value in values if value is not None), None)
    return (
        date_order(value for value in values if isinstance(value, str)) if isinstance(first, str) else CellKind.NUMBER
    )


def _floats(column: Column, values: Values) -> NDArray[np.float64]:
    """Return a column as floats, with NaN for missing values; timestamps in seconds since 1970.

    Raises:
        BatchError: A value is not of the kind of the column.
        UserError: A text is not a date and time.
    """
    if isinstance(values, np.ndarray):
        if values.dtype.kind == "M":
            seconds = values.astype("datetime64[us]").astype(np.int64) / 1e6
            return np.where(np.isnat(values), np.nan, seconds)
        return values.astype(np.float64)
    if column.kind in DATES:
        _check_each(column.name, values, str, column.kind.value)
        return parse_column(_TABLE_NAME, column, list(values))
    if not set(map(type, values)) <= _NUMBERS:
        _check_each(column.name, values, (int, float), "number")
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


def _check_each(name: str, values: Values, types: type | tuple[type, ...], kind: str) -> None:
    for row, value in enumerate(values, start=1):
        if value is not None and (not isinstance(value, types) or isinstance(value, bool)):
            raise BatchError(f"row {row}: {name} = {repr(value)[:40]}: must be a {kind}")


def _listed_cell_voltages(name: str, rows: Values, unit: Unit) -> CellBlock:
    """Return the cell voltages of a column of lists, shape (n, m) [V].

    Raises:
        BatchError: The rows have different numbers of cells or too many values, or a value is not a number.
        OverflowError: A number is too large.
    """
    lists = [row for row in rows if row is not None]
    cells = len(lists[0]) if lists and isinstance(lists[0], list) else 0
    if not lists:
        return NO_CELLS
    if not 1 <= cells <= MAX_CELLS or any(not isinstance(row, list) or len(row) != cells for row in lists):
        raise BatchError(f"{name}: must be one list of equal length, of 1 to {MAX_CELLS} cell voltages, for each row")
    if not set(map(type, itertools.chain.from_iterable(lists))) <= _NUMBERS:
        raise BatchError(f"{name}: must be numbers")
    check_count(len(rows) * cells)
    values = np.array([[np.nan] * cells if row is None else row for row in rows], dtype=np.float64)
    with np.errstate(over="ignore"):  # an infinite voltage is implausible
        cells_v: CellBlock = values * unit.factor + unit.offset
    remove_implausible(cells_v, MIN_CELL_V, MAX_CELL_V)
    return cells_v
