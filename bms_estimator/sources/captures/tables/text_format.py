"""Format of a text table: header below a preamble, separator, units and decimal sign."""

import csv
import dataclasses
import itertools
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from io import TextIOWrapper

from bms_estimator.sources.captures.tables.cell_values import CellKind, uses_decimal_comma
from bms_estimator.sources.captures.tables.layout import Column, Layout, with_time_kinds
from bms_estimator.sources.captures.tables.layout_finder import LayoutFinder

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
    # a column without a name that is never empty is the index of the rows
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
