"""Readers of curves in CSV files: open-circuit voltage, polarization curve of a fuel cell, and trip.

A trip is a table of time and load, or a capture, whose current is the load.
"""

import csv
import gzip
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bms_estimator.forecast.trip import LoadQuantity, Trip, profile_trip
from bms_estimator.model.arrays import CurrentSign, Floats
from bms_estimator.model.decimal_text import measured
from bms_estimator.model.errors import UserError
from bms_estimator.sources.captures.replay import Capture, open_capture, read_samples
from bms_estimator.sources.captures.tables.cell_values import MAX_TEXT_CHARACTERS, parse_number, uses_decimal_comma
from bms_estimator.sources.captures.tables.layout import ColumnMap
from bms_estimator.sources.captures.tables.text_file import TextFile
from bms_estimator.sources.captures.tables.text_table import (
    MAX_HEADER_CHARACTERS,
    MAX_HEADER_LINES,
    SEPARATORS,
    is_data,
    split_cells,
)

OCV_COLUMNS = ("soc", "ocv_v", "hysteresis_v", "std_v", "per_kelvin_v")
POLARISATION_COLUMNS = ("current_a", "voltage_v", "temperature_c")


class CurveColumns(NamedTuple):
    """Columns of a curve file, in the order of SOC; shape (n,) each."""

    soc: Floats
    ocv_v: Floats
    hysteresis_v: Floats | None
    std_v: Floats | None
    """Standard deviation of ``ocv_v``."""
    per_kelvin_v: Floats | None
    """Temperature coefficient of ``ocv_v``."""


def read_curve(path: Path) -> CurveColumns | None:
    """Read the curve in a CSV file (.gz) with columns soc (0..1), ocv_v [V] and optional hysteresis_v, std_v [V] and per_kelvin_v [V/K].

    Returns:
        None if the file is not CSV or has no such columns.

    Raises:
        UserError: The columns are there, but their values are not a curve.
    """
    rows = _rows(path, OCV_COLUMNS)
    if rows is None:
        return None
    return _make_curve(path, rows)


def read_polarisation(path: Path) -> Floats | None:
    """Read the polarization curve in a CSV file (.gz) with columns current_a [A], voltage_v [V] and optional temperature_c [C].

    Returns:
        The three columns, shape (n, 3); a missing temperature is NaN. None if the file is not CSV, has no such columns,
        or has a column time_s, because then it is a capture.

    Raises:
        UserError: The columns exist, but a row lacks a number.
    """
    rows = _rows(path, POLARISATION_COLUMNS, excluded_column="time_s")
    if rows is not None and (rows.shape[0] == 0 or not np.isfinite(rows[:, :2]).all()):  # temperature is optional
        raise UserError(
            f"{path}: {'no rows' if rows.shape[0] == 0 else 'a value is missing'}: give current_a and voltage_v"
        )
    return rows


def _rows(path: Path, columns: Sequence[str], excluded_column: str = "") -> Floats | None:
    """Return columns of a CSV file, shape (n, columns), or None if the file does not have the first two.

    The other columns are optional, and NaN if absent. A file that has the column ``excluded_column`` is not read.
    """
    if not path.is_file() or not path.name.lower().endswith((".csv", ".csv.gz")):
        return None
    try:
        with gzip.open(path, "rt") if path.name.lower().endswith(".gz") else path.open() as text:
            rows = csv.DictReader(line for line in text if line.strip() and not line.startswith("#"))
            if not set(columns[:2]) <= set(rows.fieldnames or ()) or excluded_column in (rows.fieldnames or ()):
                return None
            values = [[_number(path, rows.line_num, name, row.get(name)) for name in columns] for row in rows]
    except (OSError, EOFError, UnicodeDecodeError):
        return None  # the reader of captures reports errors
    return np.array(values).reshape(-1, len(columns))


def _number(path: Path, line: int, name: str, cell: str | None) -> float:
    if cell is None:
        return float("nan")
    try:
        return measured(cell)
    except ValueError:
        raise UserError(f"{path}: line {line}: {name} = {cell!r}: must be a number") from None


def _make_curve(path: Path, values: Floats) -> CurveColumns:
    """Sort and check the values of a curve.

    Raises:
        UserError: A value is missing, the SOC is outside 0..1, or a std is not above 0.
    """
    values = values[np.argsort(values[:, 0], kind="stable")]
    soc, ocv_v, *optional = values.T
    given = [None if np.isnan(column).all() else column for column in optional]
    if soc.size == 0 or not all(np.isfinite(column).all() for column in (soc, ocv_v, *given) if column is not None):
        raise UserError(f"{path}: {'no rows' if soc.size == 0 else 'a value is missing'}: give numbers in every column")
    if soc[0] < 0.0 or soc[-1] > 1.0:
        raise UserError(f"{path}: soc runs from {soc[0]:g} to {soc[-1]:g}: must lie within 0..1, not percent")
    hysteresis_v, std_v, per_kelvin_v = given
    if std_v is not None and std_v.min() <= 0.0:
        raise UserError(f"{path}: std_v = {std_v.min():g}: must be above 0 (standard deviation of ocv_v in volts)")
    return CurveColumns(soc, ocv_v, hysteresis_v, std_v, per_kelvin_v)


TIME, VOLTAGE = "time_s", "voltage_v"
"""Names of the columns of time and voltage."""
CURRENT: LoadQuantity = "current_a"
"""Name of the column of the current, as in a capture."""
LOADS: tuple[LoadQuantity, ...] = (CURRENT, "power_w")
"""Columns that give the load."""


def read_trip(
    path: Path, *, current_sign: CurrentSign | None = None, column_map: ColumnMap | None = None
) -> tuple[Trip, Capture | None]:
    """Read the trip of a file. Return the trip, and the capture if the file is one.

    A text table with the column ``time_s`` is a profile, which must have exactly one of the columns ``current_a`` and ``power_w``.
    A table with ``time_s``, ``current_a`` and ``voltage_v`` is a capture, as is any other file.

    Args:
        path: The file.
        current_sign: Direction of positive current in a capture; None: as ``open_capture`` determines it.
        column_map: Columns of a capture by quantity; None: recognize them by their names.

    Raises:
        UserError: The file cannot be read, has no load, or its profile is invalid.
    """
    table = None if column_map else _profile_lines(path)
    if table is not None:
        return _profile(path, *table), None
    capture = open_capture(path, current_sign=current_sign, column_map=column_map)
    return _trip_of_capture(path, capture), capture


def _profile_lines(path: Path) -> tuple[list[str], list[list[str]], str] | None:
    """Return header, rows and separator of a table that is a profile; None if the file is not one."""
    try:
        with TextFile(path).open() as text:
            header_line = next(
                (line for _ in range(MAX_HEADER_LINES) if is_data(line := text.readline(MAX_HEADER_CHARACTERS))), ""
            )
            for separator in SEPARATORS:
                header = [cell.strip() for cell in split_cells(header_line, separator)]
                if TIME in header and not {CURRENT, VOLTAGE} <= set(header):
                    rows = [row for row in csv.reader(filter(is_data, text), delimiter=separator) if any(row)]
                    return header, rows, separator
    except (UserError, csv.Error, UnicodeError):  # not a text: the reader of captures reports what is wrong
        return None
    return None


def _profile(path: Path, header: Sequence[str], rows: Sequence[Sequence[str]], separator: str) -> Trip:
    """Return the trip of a table.

    Raises:
        UserError: The table does not have exactly one column of the load, or a cell is not a number.
    """
    found = [name for name in LOADS if name in header]
    if len(found) != 1:
        raise UserError(
            f"{path}: needs {TIME} and exactly one of {' and '.join(LOADS)}; its columns are {', '.join(header)}"
        )
    [quantity] = found
    has_decimal_comma = separator != "," and uses_decimal_comma([cell for row in rows for cell in row])
    time_s, values = (
        np.array(
            [
                _cell(path, row, number, header, name, decimal_comma=has_decimal_comma)
                for number, row in enumerate(rows, 1)
            ]
        )
        for name in (TIME, quantity)
    )
    try:
        return profile_trip(quantity, time_s, values)
    except UserError as error:
        raise UserError(f"{path}: {error}") from None


def _cell(
    path: Path, row: Sequence[str], number: int, header: Sequence[str], name: str, *, decimal_comma: bool
) -> float:
    """Return the number in column ``name`` of a row.

    Raises:
        UserError: The row has no such cell, or the cell is not a number.
    """
    index = header.index(name)
    if index >= len(row):
        raise UserError(f"{path}: row {number}: {len(row)} values, but the header has {len(header)} columns")
    try:
        return parse_number(row[index], decimal_comma=decimal_comma)
    except (ValueError, OverflowError):
        shown = row[index][:MAX_TEXT_CHARACTERS]
        raise UserError(f"{path}: row {number}: {name} = {shown!r}: must be a number") from None


def _trip_of_capture(path: Path, capture: Capture) -> Trip:
    """Return the trip with the current of a capture. Only samples with a current that are later than all before them count.

    Raises:
        UserError: The capture cannot be read, or ``profile_trip`` rejects it.
    """
    samples = read_samples(capture)
    samples = samples[np.isfinite(samples[TIME]) & np.isfinite(samples[CURRENT])]
    latest_s = np.maximum.accumulate(samples[TIME])
    samples = samples[np.concatenate([[True], samples[TIME][1:] > latest_s[:-1]])] if samples.size else samples
    try:
        return profile_trip(CURRENT, samples[TIME], samples[CURRENT])
    except UserError as error:
        raise UserError(f"{path}: {error}") from None
