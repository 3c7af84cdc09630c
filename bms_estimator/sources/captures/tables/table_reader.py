"""Captures as tables: choice of the reader by the first bytes of a file, and samples with the sign of their current."""

import dataclasses
import math
import zipfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Protocol

import numpy as np

from bms_estimator.model.arrays import NO_CELLS, SAMPLE, Floats, SampleBlock
from bms_estimator.model.errors import UserError
from bms_estimator.sources.captures.tables.cell_values import DATES, CellKind
from bms_estimator.sources.captures.tables.column_tables import (
    MPR_MAGIC,
    NDA_MAGIC,
    NDAX_MEMBER,
    ArrayTable,
    ColumnTable,
    ParquetTable,
    read_biologic,
    read_neware,
)
from bms_estimator.sources.captures.tables.current_sign import StateWords, UserSign, find_direction, find_words
from bms_estimator.sources.captures.tables.dialects import GENERIC, OWN
from bms_estimator.sources.captures.tables.history_export import HistoryExport
from bms_estimator.sources.captures.tables.history_records import open_records
from bms_estimator.sources.captures.tables.layout import (
    Column,
    ColumnMap,
    Layout,
    RawBlock,
    Role,
    cell_voltages,
    remove_implausible_temperatures,
    to_samples,
)
from bms_estimator.sources.captures.tables.layout_finder import LayoutFinder
from bms_estimator.sources.captures.tables.spreadsheet import Spreadsheet
from bms_estimator.sources.captures.tables.text_file import ZIP_MAGIC
from bms_estimator.sources.captures.tables.text_table import TextTable
from bms_estimator.sources.captures.tables.time_base import ClockUnwrapper, find_time_base, is_descending
from bms_estimator.sources.captures.tables.voltage_response import VoltageResponse, voltage_response

FIRST_ROWS = 262_144
"""Minimum number of rows at the beginning of a table that determine its time base and the sign of the current."""
MAX_SHOWN_BATTERIES = 8
"""Maximum number of batteries in a message."""
STEP_SEPARATION_S = 1e-6
"""Time that is inserted between two rows with the same time and different currents [s]."""
PARQUET_MAGIC, OLE_MAGIC = b"PAR1", b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1"
"""First bytes of Parquet files and of .xls files."""
EXCEL_MEMBER, OPEN_DOCUMENT_MEMBER = "[Content_Types].xml", "mimetype"
"""Members of .xlsx and .ods files, which are zip archives."""


class TableReader(Protocol):
    """Reader of the columns of a sample in a table."""

    layout: Layout
    """Columns that are read."""

    @property
    def description(self) -> str:
        """Kind of the file for messages."""

    @property
    def warning(self) -> str:
        """Fault of the rows that were read; empty without one."""

    @property
    def fraction(self) -> float:
        """Fraction of the table that has been read, 0..1."""

    def blocks(self) -> Iterator[RawBlock]:
        """Yield blocks of rows."""


class Table:
    """Samples of a table; a ``Capture``.

    Args:
        name: Name of the table for messages.
        reader: Reader of the columns.
        configured: Direction of positive current that the user configured.
        instance: Number of the battery whose rows are read; None: the table must have rows of one battery only.

    Attributes:
        layout: Columns of the table.
        implausible: Number of implausible temperatures in the rows read so far.
        cells: Cell voltages of the last block.
        note: Description of dialect, columns and sign; empty for a table with this project's columns.
    """

    def __init__(self, name: object, reader: TableReader, configured: UserSign, instance: float | None = None) -> None:
        self._name, self._reader, self._instance = name, reader, instance
        self.implausible, self.cells = 0, NO_CELLS
        self._newest_first = False
        first = self._first_rows()
        if reader.layout.dialect is not OWN and is_descending(first[Role.TIME]):
            self._newest_first = True
            first = self._first_rows()
        time_base = find_time_base(reader.layout, first)
        first[Role.TIME], self._is_step_time = first[time_base.role], time_base.is_step_time
        layout, ignored = _without_zero_temperature(time_base.layout, first)
        self.layout = reader.layout = layout
        words = find_words(first[Role.STATE], first[Role.CURRENT]) if Role.STATE in first else StateWords()
        response = VoltageResponse() if configured.option else self._voltage_response(first, words)
        self._direction = find_direction(name, self.layout, configured, response, words)
        is_own = self.layout.dialect is OWN and not self.layout.has_given_columns
        self.note = (
            ""
            if is_own
            else _note(reader, time_base.reason, self._direction.text)
            + ignored
            + _cells_in_series(first)
            + self._newest_first * "; the newest row is the first: read in reverse order"
        )
        self._warnings = (time_base.warning, self._direction.warning)

    @property
    def warning(self) -> str:
        """Contradictions of time and sign, and faults of the rows read so far; empty without one."""
        return "; ".join(filter(None, (*self._warnings, self._reader.warning)))

    @property
    def fraction(self) -> float:
        """Fraction of the table that has been read, 0..1."""
        return self._reader.fraction

    def __iter__(self) -> Iterator[SampleBlock]:
        """Yield blocks of samples, with the current positive on discharge.

        Raises:
            UserError: The table cannot be read; the message names file, line and column.
        """
        self.implausible = 0
        before = np.empty(0, dtype=SAMPLE)
        start_s, rows = None, 0
        unwrapper = self._clock_unwrapper()
        for raw in self._rows():
            samples = to_samples(raw, self.layout)
            samples["time_s"] = unwrapper.apply(samples["time_s"])
            if Role.CLOCK in self.layout.columns or self.layout.columns[Role.TIME].kind in DATES:
                start_s = _first_finite(samples["time_s"]) if start_s is None else start_s
                samples["time_s"] -= start_s
            samples["current_a"] *= self._direction.factor
            if self._direction.row_factors is not None:
                factors = self._direction.row_factors[rows : rows + samples.size]
                samples["current_a"] = factors * np.abs(samples["current_a"])
                rows += samples.size
            if self._direction.is_from_states:
                state = raw[Role.STATE]
                directed = state * np.abs(samples["current_a"])
                samples["current_a"] = np.where(np.abs(state) == 1.0, directed, samples["current_a"])
            if self.layout.dialect is not OWN:  # this project's tables hold the time stamps that a source delivered
                before = _separate_steps(before, samples)
            self.implausible += remove_implausible_temperatures(samples)
            self.cells = cell_voltages(raw, self.layout)
            yield samples

    def _voltage_response(self, first: RawBlock, words: StateWords) -> VoltageResponse:
        """Return the response of the voltage in the first rows; of all rows if the current has no sign."""
        response = self._response(first)
        if not response.has_no_sign or words.in_all_loads or first[Role.TIME].size < FIRST_ROWS:
            return response
        return self._response(self._first_rows(math.inf))

    def _response(self, rows: RawBlock) -> VoltageResponse:
        samples = to_samples(rows, self.layout)
        samples["time_s"] = self._clock_unwrapper().apply(samples["time_s"])
        return voltage_response(samples)

    def _clock_unwrapper(self) -> ClockUnwrapper:
        """Return a new correction of times that roll over or restart. Times of the day need none if a column has the dates."""
        time = self.layout.columns[Role.CLOCK if Role.CLOCK in self.layout.columns else Role.TIME]
        return ClockUnwrapper(time, is_step_time=self._is_step_time)

    def _rows(self) -> Iterator[RawBlock]:
        """Yield blocks with the rows of the battery, the oldest first."""
        blocks = _rows_of_battery(self._name, self._reader, self._instance)
        if not self._newest_first:
            yield from blocks
            return
        for raw in reversed(list(blocks)):
            yield {role: values[::-1] for role, values in raw.items()}

    def _first_rows(self, min_rows: float = FIRST_ROWS) -> RawBlock:
        """Return rows at the beginning of the table, at least ``min_rows`` if it has as many."""
        blocks, rows = list[RawBlock](), 0
        for raw in self._rows():
            blocks.append(raw)
            rows += raw[Role.TIME].size
            if rows >= min_rows:
                break
        columns = self._reader.layout.columns
        return {role: np.concatenate([np.empty(0), *(raw[role] for raw in blocks)]) for role in columns}


def _rows_of_battery(name: object, reader: TableReader, instance: float | None) -> Iterator[RawBlock]:
    """Yield blocks with the rows of one battery.

    Raises:
        UserError: The table has rows of several batteries and none is chosen, or none of the chosen battery.
    """
    column = reader.layout.columns.get(Role.INSTANCE)
    if column is None:
        if instance is not None:
            raise UserError(
                f"{name}: --map instance={instance:g}: the table has no column with the number of the battery"
            )
        yield from reader.blocks()
        return
    found = set[float]()
    for raw in reader.blocks():
        numbers = raw[Role.INSTANCE]
        found |= set(np.unique(numbers[np.isfinite(numbers)]).tolist())
        if instance is None and len(found) > 1 and min(found) < 0.0:  # names are read as negative numbers
            raise UserError(
                f"{name}: rows of several batteries, with different names in {column.name}: keep the rows of one"
            )
        if instance is None and len(found) > 1:
            raise UserError(
                f"{name}: rows of several batteries, {column.name} = {_join_numbers(found)}: choose one by "
                f"--map instance={min(found):g} (in Python: column_map)"
            )
        chosen = np.ones(numbers.size, dtype=bool) if instance is None else numbers == instance
        if chosen.any():
            yield {role: values[chosen] for role, values in raw.items()}
    if instance is not None and instance not in found:
        raise UserError(f"{name}: --map instance={instance:g}: no such battery; {column.name} = {_join_numbers(found)}")


def _join_numbers(numbers: set[float]) -> str:
    """Return numbers of batteries for messages, limited in number."""
    return ", ".join(f"{number:g}" for number in sorted(numbers)[:MAX_SHOWN_BATTERIES]) or "empty"


def _cells_in_series(first: RawBlock) -> str:
    """Return the number of cells in series that the table states, as text for the note; empty if it states none."""
    counts = first.get(Role.SERIES, np.empty(0))
    count = float(np.median(counts[counts > 0.0])) if (counts > 0.0).any() else 0.0
    is_whole = 0.0 < count == round(count) < np.inf
    return f"; {count:.0f} cells in series (calibrate, report: --series {count:.0f})" if is_whole else ""


def _without_zero_temperature(layout: Layout, first: RawBlock) -> tuple[Layout, str]:
    """Return the layout without a temperature that is exactly 0 in each row, and a text that says so.

    Programs write 0 if no probe is connected. Tables of this project omit the column instead. A column that the user named is kept.
    """
    is_zero = Role.TEMPERATURE in first and not np.nan_to_num(first[Role.TEMPERATURE], nan=0.0).any()
    if not is_zero or layout.dialect is OWN or layout.has_given_columns:
        return layout, ""
    columns = dict(layout.columns)
    temperature = columns.pop(Role.TEMPERATURE)
    return dataclasses.replace(layout, columns=columns), f'; "{temperature.name}" is 0 in each row: no temperature'


def _separate_steps(before: SampleBlock, samples: SampleBlock) -> SampleBlock:
    """Separate rows that have the same time but different currents: add ``STEP_SEPARATION_S`` to the time of the last such row.

    Cyclers write the last row of a step and the first row of the next step at the same time. Both rows are needed, because
    each gives the current on its side of the step.

    Args:
        before: Return value for the previous block; empty for the first block.
        samples: Block of samples, whose times are changed.

    Returns:
        The first of the rows that have the time of the block's last row.
    """
    rows = np.concatenate([before, samples])
    time_s, current_a = rows["time_s"], rows["current_a"]
    repeats = np.concatenate([[False], time_s[1:] == time_s[:-1]])
    is_last = repeats & ~np.append(repeats[1:], False)
    first = np.maximum.accumulate(np.where(repeats, 0, np.arange(rows.size)))  # index of the first row with the time
    is_step = is_last & (current_a != current_a[first])
    samples["time_s"][is_step[before.size :]] += STEP_SEPARATION_S
    first_of_last_time: SampleBlock = rows[first[-1:]]
    return first_of_last_time


def _first_finite(values: Floats) -> float:
    finite = values[np.isfinite(values)]
    return float(finite[0]) if finite.size else 0.0


def _note(reader: TableReader, time_reason: str, direction: str) -> str:
    """Return the dialect, the columns with their units, the reason for the time and the sign of the current, as text."""
    layout = reader.layout
    name = " with ".join(
        [layout.dialect.name] * (layout.dialect is not GENERIC or not layout.has_given_columns)
        + ["given columns"] * layout.has_given_columns
    )
    reasons = {Role.TIME: f" ({time_reason})" if time_reason else "", Role.CURRENT: f", {direction}"}
    columns = [
        _column_text(role, layout.columns[role]) + reasons.get(role, "")
        for role in _SHOWN_ROLES
        if role in layout.columns
    ]
    return f"read as {name} ({reader.description}): {'; '.join(columns)}"


_SHOWN_ROLES = (Role.TIME, Role.CURRENT, Role.VOLTAGE, Role.TEMPERATURE)


def _column_text(role: Role, column: Column) -> str:
    """Return a quantity with its column and unit, as text."""
    if column.kind is not CellKind.NUMBER:
        return f'{role.value} "{column.name}" as {column.kind.value}'
    return f'{role.value} "{column.name}" in {column.unit.symbol}{" (assumed)" if column.assumed else ""}'


def open_table(path: Path, configured: UserSign, column_map: ColumnMap | None = None) -> Table:
    """Open a table; its format is recognized by the first bytes of the file, and for text by its columns.

    Raises:
        UserError: The file cannot be read, has no columns of a sample, or has no sheets although one is given.
    """
    finder = LayoutFinder(path, column_map)
    reader = _open_reader(path, finder)
    if finder.sheet is not None and not isinstance(reader, Spreadsheet):
        raise UserError(f"{path}: sheet {finder.sheet} is given, but the file is not a spreadsheet")
    return Table(path, reader, configured, finder.instance)


def _open_reader(path: Path, finder: LayoutFinder) -> TableReader:
    try:
        with path.open("rb") as file:
            head = file.read(len(MPR_MAGIC))  # the longest magic number
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror}") from None
    if head.startswith(ZIP_MAGIC):
        return _open_archive(path, finder)
    readers: dict[bytes, Callable[[Path, LayoutFinder], TableReader]] = {
        PARQUET_MAGIC: ParquetTable,
        OLE_MAGIC: Spreadsheet,
        NDA_MAGIC: partial(read_neware, suffix=".nda"),
        MPR_MAGIC: read_biologic,
    }
    reader = next((reader for magic, reader in readers.items() if head.startswith(magic)), _open_text)
    return reader(path, finder)


def _open_archive(path: Path, finder: LayoutFinder) -> TableReader:
    """Open a zip archive: a Neware file, a spreadsheet or a compressed text."""
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.namelist()
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError):
        members = []  # the reader of text reports the error
    if any(member.endswith(NDAX_MEMBER) for member in members):
        return read_neware(path, finder, ".ndax")
    if {EXCEL_MEMBER, OPEN_DOCUMENT_MEMBER} & set(members):
        return Spreadsheet(path, finder)
    return _open_text(path, finder)


def _open_text(path: Path, finder: LayoutFinder) -> TableReader:
    """Open a text: a history of entities or a table with a column of each quantity."""
    records = open_records(path, finder)
    return HistoryExport(path, finder, records) if records else TextTable(path, finder)


def convert_table(table: ColumnTable, configured: UserSign, column_map: ColumnMap | None = None) -> Table:
    """Return the samples of a table in memory.

    Raises:
        UserError: A column is missing or does not contain numbers.
    """
    name = "the table"
    finder = LayoutFinder(name, column_map)
    return Table(name, ArrayTable(name, table, finder), configured, finder.instance)
