"""Format of a text table: header below a preamble, separator, units and decimal sign."""

import csv
import dataclasses
import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from io import TextIOWrapper

from bms_estimator.sources.captures.tables.cell_values import CellKind, uses_decimal_comma
from bms_estimator.sources.captures.tables.layout import Column, Layout, LayoutFinder, with_time_kinds, with_units

MAX_HEADER_LINES = 2_000
"""Maximum number of lines up to the header."""
MAX_HEADER_CHARACTERS = 1 << 20
"""Maximum length of a line that is searched for the header."""
PROBED_LINES = 200
"""Number of lines after the header that show units, decimal sign and format of the time."""
SEPARATORS = {"\t": "tab", ";": "semicolon", ",": "comma"}
"""Separators of columns, in the order in which they are tried, with their names."""


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
    """

    layout: Layout
    header: str
    width: int
    first_line: int
    separator: str
    decimal_comma: bool = False


def is_data(line: str) -> bool:
    """Return True if a line is neither empty nor a comment."""
    return bool(line.strip()) and not line.startswith("#")


def split_cells(line: str, separator: str) -> list[str]:
    """Return the cells of a line; an empty list if it is not valid CSV."""
    try:
        return next(csv.reader([line], delimiter=separator))
    except (csv.Error, StopIteration):
        return []


def find_format(text: TextIOWrapper, finder: LayoutFinder) -> TextFormat:
    """Find the header, and recognize the format by the lines after it.

    Raises:
        UserError: No line is a header.
    """
    for number in range(1, MAX_HEADER_LINES + 1):
        line = text.readline(MAX_HEADER_CHARACTERS)
        if not line:
            break
        if "\0" in line:
            raise finder.no_header()
        if not is_data(line):
            continue
        for separator in SEPARATORS:
            header = split_cells(line, separator)
            layout = finder.find(header)
            if layout is not None:
                text_format = TextFormat(layout, line, len(header), number + 1, separator)
                return _probe(text_format, list(itertools.islice(text, PROBED_LINES)), text)
    raise finder.no_header()


def _probe(text_format: TextFormat, lines: Sequence[str], rest: Iterable[str]) -> TextFormat:
    """Return the format completed by the first lines after the header: units, decimal sign and format of the time.

    The order of day and month follows from all dates, also from those in the ``rest`` of the lines.
    """
    rows = [split_cells(line, text_format.separator) for line in lines if is_data(line)]
    first_line, layout = text_format.first_line, text_format.layout
    if rows and (layout_with_units := with_units(layout, rows[0])):
        layout = layout_with_units
        first_line += 1 + next(index for index, line in enumerate(lines) if is_data(line))
        rows = rows[1:]
    complete = [row for row in rows if len(row) > max(column.index for column in layout.columns.values())]
    later = (split_cells(line, text_format.separator) for line in rest)

    def cells_of(column: Column) -> Iterator[str]:
        return (row[column.index] for row in itertools.chain(complete, later) if len(row) > column.index)

    layout = with_time_kinds(layout, cells_of)
    numeric = [column.index for column in layout.columns.values() if column.kind is CellKind.NUMBER]
    decimal_comma = uses_decimal_comma([row[index] for row in complete for index in numeric])
    return dataclasses.replace(text_format, layout=layout, first_line=first_line, decimal_comma=decimal_comma)
