"""Readers of curves in CSV files: open-circuit voltage, and polarization curve of a fuel cell."""

import csv
import gzip
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bms_estimator.model.arrays import Floats
from bms_estimator.model.decimal_text import measured
from bms_estimator.model.errors import UserError

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
