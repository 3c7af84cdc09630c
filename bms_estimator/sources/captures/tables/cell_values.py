"""Values of cells: numbers with decimal point or comma, durations, date-times, and words for charge and discharge."""

import re
from collections.abc import Callable
from datetime import UTC, datetime
from enum import Enum
from functools import partial

from bms_estimator.model.decimal_text import measured

_DURATION = re.compile(r"(?:(\d{1,6})(?:\s*(?:days?,?|d|-)\s*|\s+))?(\d{1,6}):(\d{1,2}):(\d{1,2}(?:[.,]\d+)?)")
_DATE_TIME = re.compile(
    r"(\d{1,4})([./-])(\d{1,2})\2(\d{1,4})[T ]+(\d{1,2}):(\d{1,2})(?::(\d{1,2})([.,:]\d+)?)?\s*([AP]M)?", re.IGNORECASE
)
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?")
_GROUPED_DIGITS = re.compile(r"[-+]?\d{1,3}(?:,\d{3})+(?:\.\d*)?")
_WORD = re.compile(r"[^\W\d_]+")
_DISCHARGE = frozenset(
    {"d", "dchg", "dch", "dis", "disc", "dischg", "discharge", "discharging", "entladen", "entladung"}
)
_CHARGE = frozenset({"c", "chg", "cha", "charge", "charging", "laden", "ladung"})

MAX_TEXT_CHARACTERS = 40
"""Maximum length of a time stamp or state, and of an invalid cell in a message. Longer texts are cut off."""


class CellKind(Enum):
    """Kind of a column's cells."""

    NUMBER = "number"
    DURATION = "duration"
    DATE_TIME = "date and time"
    DIRECTION = "direction"


def parse_number(cell: str, *, decimal_comma: bool) -> float:
    """Parse a number; an empty cell, or a word such as nan, is NaN.

    Args:
        cell: The text. Commas between groups of three digits are ignored, unless ``decimal_comma`` is set.
        decimal_comma: The decimal separator is a comma.

    Raises:
        ValueError: The text is not a number.
    """
    cell = cell.strip()
    if not cell:
        return float("nan")
    if decimal_comma:
        cell = cell.replace(",", ".")
    elif _GROUPED_DIGITS.fullmatch(cell):
        cell = cell.replace(",", "")
    return measured(cell)


def parse_duration(cell: str) -> float:
    """Return the seconds in a text such as ``26:03:04.5`` or ``1d 02:03:04.5``.

    Raises:
        ValueError: The text is not a duration.
    """
    match = _DURATION.fullmatch(cell.strip())
    if not match:
        raise ValueError(f"{cell[:MAX_TEXT_CHARACTERS]!r}: no duration")
    days, hours, minutes, seconds = match.groups()
    return 86_400.0 * int(days or 0) + 3600.0 * int(hours) + 60.0 * int(minutes) + float(seconds.replace(",", "."))


def parse_date_time(cell: str) -> float:
    """Return the Unix time of a date and time [s]; UTC if the text has no time zone.

    Formats are ISO 8601, year first, day first with periods, and month first with slashes or hyphens. A first number
    above 12 is the day.

    Raises:
        ValueError: The text is not a date with time.
    """
    cell = cell.strip()
    match = _DATE_TIME.fullmatch(cell)
    if not match:
        return _unix_s(datetime.fromisoformat(cell))
    first, separator, second, third, hour, minute, seconds, fraction, am_pm = match.groups()
    if len(first) == 4:
        year, month, day = int(first), int(second), int(third)
    elif separator == "." or int(first) > 12:
        day, month, year = int(first), int(second), int(third)
    else:
        month, day, year = int(first), int(second), int(third)
    hours = int(hour) % 12 + 12 * (am_pm.upper() == "PM") if am_pm else int(hour)
    if year < 100:  # two digits
        year += 2000
    whole = datetime(year, month, day, hours, int(minute), int(seconds or 0), tzinfo=UTC)
    return whole.timestamp() + (float(f"0.{fraction[1:]}") if fraction else 0.0)


def _unix_s(moment: datetime) -> float:
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def parse_direction(cell: str) -> float:
    """Return 1 for a text with a word for discharge, -1 with a word for charge, and 0 for other texts, such as rest or pause."""
    words = {word.lower() for word in _WORD.findall(cell)}
    return 1.0 if words & _DISCHARGE else -1.0 if words & _CHARGE else 0.0


def uses_decimal_comma(cells: list[str]) -> bool:
    """Return True if cells have a comma where a decimal point would be, and none has a point."""
    return any(_DECIMAL_COMMA.fullmatch(cell.strip()) for cell in cells) and not any("." in cell for cell in cells)


def time_kind(cell: str) -> CellKind:
    """Return the kind of a cell in the time column. An unknown kind counts as a number, whose parser reports the error."""
    for kind in (CellKind.NUMBER, CellKind.DURATION, CellKind.DATE_TIME):
        try:
            parser(kind, decimal_comma="," in cell)(cell)
        except (ValueError, OverflowError):
            continue
        return kind
    return CellKind.NUMBER


def parser(kind: CellKind, *, decimal_comma: bool) -> Callable[[str], float]:
    """Return the function that converts the cells of a column; it raises ValueError or OverflowError."""
    if kind is CellKind.NUMBER:
        return partial(parse_number, decimal_comma=decimal_comma)
    return {
        CellKind.DURATION: parse_duration,
        CellKind.DATE_TIME: parse_date_time,
        CellKind.DIRECTION: parse_direction,
    }[kind]
