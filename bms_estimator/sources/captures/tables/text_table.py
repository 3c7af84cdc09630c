"""Reader of delimited text with any preamble, separator and decimal sign. It reads blocks, to limit the memory."""

import csv
import dataclasses
import itertools
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from io import TextIOWrapper
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bms_estimator.model.errors import UserError
from bms_estimator.sources.captures.tables.cell_values import MAX_TEXT_CHARACTERS, CellKind, uses_decimal_comma
from bms_estimator.sources.captures.tables.layout import (
    BLOCK_ROWS,
    REQUIRED,
    Column,
    ColumnRole,
    Layout,
    RawBlock,
    Role,
    with_time_kinds,
)
from bms_estimator.sources.captures.tables.layout_finder import LayoutFinder
from bms_estimator.sources.captures.tables.text_file import TextFile

MAX_HEADER_LINES = 2_000
"""Maximum number of lines up to the header."""
MAX_HEADER_CHARACTERS = 1 << 20
"""Maximum length of a line that is searched for the header."""
PROBED_LINES = 200
"""Number of lines after the header that show units, decimal sign and format of the time."""
_DEVICE = re.compile(r".+ \[\d+\]")
"""Name of a device, such as ``Battery Monitor [278]``. Victron VRM writes it in the line above the column names."""
_NOT_SPACE_SEPARATED = re.compile(r"[\t;|]|,(?!\d)|[:'](?:\s|$)")
"""Characters that show that spaces do not separate columns: other separators, and punctuation after a word. A comma before a
digit is a decimal comma."""
SEPARATORS = {"\t": "tab", ";": "semicolon", ",": "comma", "|": "vertical bar", " ": "space"}
"""Separators of columns, in the order in which they are tried, with their names. Any number of spaces is one separator."""


@dataclass(frozen=True)
class TextFormat:
    """Format of a text table.

    Attributes:
        layout: Columns of the table.
        header: Text of the line with the column names.
        width: Number of columns.
        first_line: Number of the first line after header and units, counted from 1.
        separator: Separator of columns.
        decimal_comma: True if the decimal separator is a comma.
        is_quoted: True if each line is in quotes as a whole.
        upper_layers: Number of columns at the left that describe cycles and steps, and are empty in lines of samples.
    """

    layout: Layout
    header: str
    width: int
    first_line: int
    separator: str
    decimal_comma: bool = False
    is_quoted: bool = False
    upper_layers: int = 0


def is_data(line: str) -> bool:
    """Return True if a line is neither empty nor a comment."""
    return bool(line.strip()) and not line.startswith("#")


def unquote(line: str) -> str:
    """Remove the quotes around a whole line. Return any other line unchanged."""
    text = line.strip()
    inner = text[1:-1].replace('""', "")
    is_quoted = len(text) > 1 and text[0] == text[-1] == '"' and '"' not in inner
    return text[1:-1].replace('""', '"') if is_quoted else line


def split_cells(line: str, separator: str) -> list[str]:
    """Return the cells of a line; an empty list if it is not valid CSV, or if spaces separate words of a text."""
    if separator == " ":
        return [] if _NOT_SPACE_SEPARATED.search(line) else line.split()
    try:
        return next(csv.reader([line], delimiter=separator))
    except (csv.Error, StopIteration):
        return []


def find_format(text: TextIOWrapper, finder: LayoutFinder) -> TextFormat:
    """Find the header, and recognize the format by the lines after it.

    Raises:
        UserError: No line is a header.
    """
    above = ""
    for number in range(1, MAX_HEADER_LINES + 1):
        line = text.readline(MAX_HEADER_CHARACTERS)
        if not line:
            break
        if "\0" in line:
            raise finder.no_header_error()
        if not is_data(line):
            continue
        names = unquote(line)
        for separator in SEPARATORS:
            header = _with_devices(split_cells(above, separator), split_cells(names, separator))
            layout = finder.find(header)
            if layout is not None:
                text_format = TextFormat(layout, names, len(header), number + 1, separator, is_quoted=names != line)
                return _probe(text_format, text, finder, header)
        above = names
    raise finder.no_header_error()


def _with_devices(devices: Sequence[str], header: Sequence[str]) -> Sequence[str]:
    """Return column names with the names of the devices in the line above, if it has any."""
    if len(devices) != len(header) or not any(map(_DEVICE.fullmatch, devices)):
        return header
    # VRM names the time column by a time zone and writes ``timestamp`` above it, which replaces the name
    return [
        f"{device} {name}" if _DEVICE.fullmatch(device) else device or name
        for device, name in zip(devices, header, strict=True)
    ]


def _probe(text_format: TextFormat, text: TextIOWrapper, finder: LayoutFinder, header: Sequence[str]) -> TextFormat:
    """Return the format completed by the first lines after the header: units, layers, decimal sign and format of the time.

    The order of day and month follows from the dates of all lines.
    """
    unquoted_text = map(unquote, text) if text_format.is_quoted else text
    lines = list(itertools.islice(unquoted_text, PROBED_LINES))
    rows = [split_cells(line, text_format.separator) for line in lines if is_data(line)]
    first_line, layout = text_format.first_line, text_format.layout
    if rows and (layout_with_units := finder.with_units(layout, rows[0])):
        layout = layout_with_units
        first_line += 1 + next(index for index, line in enumerate(lines) if is_data(line))
        rows = rows[1:]
    upper_layers = next(index for index, cell in enumerate(header) if cell.strip())
    # no layers: the first columns have no names and are never empty, such as an index of the rows
    if not any(row and not any(row[:upper_layers]) for row in rows):
        upper_layers = 0
    rows = [row for row in rows if not any(row[:upper_layers])]
    complete = [row for row in rows if len(row) > max(column.index for column in layout.columns.values())]
    later = (split_cells(line, text_format.separator) for line in unquoted_text)

    def cells_of(column: Column) -> Iterator[str]:
        return (row[column.index] for row in itertools.chain(complete, later) if len(row) > column.index)

    layout = with_time_kinds(layout, cells_of)
    numeric = [column.index for column in layout.columns.values() if column.kind is CellKind.NUMBER]
    decimal_comma = uses_decimal_comma([row[index] for row in complete for index in numeric])
    return dataclasses.replace(
        text_format, layout=layout, first_line=first_line, decimal_comma=decimal_comma, upper_layers=upper_layers
    )


_WITH_UNIT = re.compile(r"[-+\d.,]+\s*[^\W\d]{1,3}")
TEXT_DTYPE = f"U{MAX_TEXT_CHARACTERS}"


class TextTable:
    """Reader of a table in text. Lines that start with # are comments.

    Args:
        path: The file.
        finder: Finder of the columns.

    Attributes:
        layout: Columns of the table.
        description: Format in words.
        warning: Warning about a row that is not used, after all blocks were read; empty without one.

    Raises:
        UserError: The file cannot be read, or no line is a header.
    """

    def __init__(self, path: Path, finder: LayoutFinder) -> None:
        self._path, self._file, self.warning = path, TextFile(path), ""
        with self._file.open() as text:
            self._format = find_format(text, finder)
        self.layout = self._format.layout
        self.description = f"text, separator {SEPARATORS[self._format.separator]}" + (
            ", decimal comma" if self._format.decimal_comma else ""
        )

    @property
    def fraction(self) -> float:
        """Fraction of the file that has been read, 0..1."""
        return self._file.fraction

    def blocks(self) -> Iterator[RawBlock]:
        """Yield blocks of at most ``BLOCK_ROWS`` rows.

        These lines are ignored: a repeated header with the preamble above it, lines without numbers after the last row, and a
        last row that is cut off.

        Raises:
            UserError: A row is not valid; the message names file, line and column.
        """
        with self._file.open() as text:
            line = self._format.first_line
            for _ in itertools.islice(text, line - 1):
                pass
            row_parser = _RowParser(self._path, self._format, self.layout)
            count = 0
            data_lines = map(unquote, text) if self._format.is_quoted else text
            while lines := list(itertools.islice(data_lines, BLOCK_ROWS)):
                values = self._fast_values(lines)
                if values is None:
                    values = row_parser.parse(lines, line)
                elif row_parser.pending_error:
                    raise row_parser.pending_error
                line += len(lines)
                if values and values[Role.TIME].size:
                    count += values[Role.TIME].size
                    yield values
            self.warning = row_parser.cut_line
            if count == 0:
                raise UserError(f"{self._path}: no samples after the header in line {self._format.first_line - 1}")

    def _fast_values(self, lines: Sequence[str]) -> RawBlock | None:
        """Return the columns of some lines with numpy's fast parser; None if a line has an empty cell or is not a row."""
        columns = self.layout.columns
        if self._format.upper_layers:
            return None
        if self._format.decimal_comma:
            if self._format.separator == ",":  # numbers are quoted, so that only the CSV parser separates them
                return None
            lines = [line.replace(",", ".") for line in lines]
        if not any(line.strip() for line in lines):
            return {}
        dtypes = {role.value: "f8" if c.kind is CellKind.NUMBER else TEXT_DTYPE for role, c in columns.items()}
        try:
            table = np.loadtxt(
                lines,
                dtype=list(dtypes.items()),
                delimiter=self._format.separator,
                usecols=[column.index for column in columns.values()],
                ndmin=1,
                quotechar='"',
                comments=None,
            )
            return {role: _convert(column, table[role.value]) for role, column in columns.items()}
        except (ValueError, OverflowError):
            return None


def _convert(column: Column, cells: NDArray[np.float64] | NDArray[np.str_]) -> NDArray[np.float64]:
    """Convert a column that numpy's parser has read as numbers or as text to floats."""
    if column.kind is CellKind.NUMBER:
        return cells.astype(np.float64)
    parse = column.parser(decimal_comma=False)
    if column.kind in (CellKind.DIRECTION, CellKind.LABEL):  # few different words
        words, index = np.unique(cells, return_inverse=True)
        return np.array([parse(str(word)) for word in words])[index]
    return np.array([parse(cell) for cell in cells.tolist()])


class _RowParser:
    """Parser of rows cell by cell, which names line and column of an error.

    Attributes:
        pending_error: Error of the first line since the last row that is not a row. It is raised only if a row follows.
        cut_line: Description of a last row that is cut off; empty without one.
    """

    def __init__(self, path: Path, text_format: TextFormat, layout: Layout) -> None:
        self._path, self._format, self._columns = path, text_format, layout.columns
        self._parsers = {
            role: column.parser(decimal_comma=text_format.decimal_comma) for role, column in layout.columns.items()
        }
        self._last_index = max(column.index for column in layout.columns.values())
        self.pending_error: UserError | None = None
        self.cut_line = ""

    def parse(self, lines: Sequence[str], first_line: int) -> RawBlock:
        """Return the columns of some lines."""
        rows = []
        for number, line in enumerate(lines, first_line):
            if not is_data(line):
                continue
            if line.strip() == self._format.header.strip():  # the program was restarted, and wrote its preamble again
                self.pending_error = None
                continue
            cells = split_cells(line, self._format.separator)
            if not any(cell.strip() for cell in cells) or any(cells[: self._format.upper_layers]):
                continue
            if self.pending_error and not self._has_no_value(cells):
                raise self.pending_error
            if self._has_no_value(cells):
                text = f"{line.strip()[:MAX_TEXT_CHARACTERS]!r}: not a row of numbers, though rows follow"
                self.pending_error = self.pending_error or UserError(f"{self._path}: line {number}: {text}")
            elif len(cells) <= self._last_index:
                text = f"line {number}: {len(cells)} values, but the header has {self._format.width} columns"
                self.pending_error = UserError(f"{self._path}: {text}")
                self.cut_line = f"{text}: the last row is cut off, and not used"
            else:
                rows.append([self._value(*each, cells, number) for each in self._columns.items()])
        return dict(zip(self._columns, np.array(rows).T, strict=True)) if rows else {}

    def _has_no_value(self, cells: Sequence[str]) -> bool:
        """Return True if none of time, current and voltage can be read."""
        for quantity in REQUIRED:
            index = self._columns[Role(quantity)].index
            if index < len(cells) and cells[index].strip():
                try:
                    self._parsers[Role(quantity)](cells[index])
                except (ValueError, OverflowError):
                    continue
                return False
        return True

    def _value(self, role: ColumnRole, column: Column, cells: Sequence[str], line: int) -> float:
        cell = cells[column.index]
        if not cell.strip():
            return float("nan")
        try:
            return self._parsers[role](cell)
        except (ValueError, OverflowError):
            kind = "number" if column.kind is CellKind.NUMBER else column.kind.value
            if role is Role.TIME and column.kind is CellKind.NUMBER:
                kind = "number, a duration h:m:s, or a date and time"
            elif _WITH_UNIT.fullmatch(cell.strip()):
                kind = (
                    f"number without its unit, which belongs to the header, as in {column.name} [{column.unit.symbol}]"
                )
            shown = cell[:MAX_TEXT_CHARACTERS]
            raise UserError(f"{self._path}: line {line}: {column.name} = {shown!r}: must be a {kind}") from None
