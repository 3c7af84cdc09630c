"""Values of cells: numbers with decimal point or comma, durations, date-times, and words for charge and discharge."""

import itertools
import re
import zlib
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from enum import Enum
from functools import partial

from bms_estimator.model.decimal_text import measured

_DURATION = re.compile(r"(?:(\d{1,6})(?:\s*(?:days?,?|d|-)\s*|\s+))?(\d{1,6}):(\d{1,2}):(\d{1,2}(?:[.,]\d+)?)")
_DATE_TIME = re.compile(
    r"(\d{1,4})([./-])(\d{1,2})\2(\d{1,4})(?:[T ]+(\d{1,2}):(\d{1,2})(?::(\d{1,2})([.,:]\d+)?)?\s*([AP]M)?)?",
    re.IGNORECASE,
)
_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_MONTH_NAME = re.compile(rf"(\d{{1,2}})[- ]({'|'.join(_MONTHS)})[a-z]*[- ](\d{{2,4}})\b", re.IGNORECASE)
"""Day, name of the month and year at the beginning of a date."""
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?")
_GROUPED_DIGITS = re.compile(r"[-+]?\d{1,3}(?:,\d{3})+(?:\.\d*)?")
_GROUPED_BY_POINTS = re.compile(r"[-+]?\d{1,3}(?:\.\d{3})+,\d+")
_GROUPING_SPACE = re.compile(r"(?<=\d)[ '\u2019\u00a0\u202f](?=\d{3}(?!\d))")
"""Space or apostrophe between groups of three digits."""
_WORD = re.compile(r"[^\W\d_]+")
_DISCHARGE = frozenset(
    [
        "d",
        "dchg",
        "dch",
        "dchrg",
        "dis",
        "disc",
        "disch",
        "dischg",
        "dischrg",
        "discharge",
        "discharging",
        "dsc",
        "dsch",
        "dsg",
        "entladen",
        "entladung",
        "décharge",
        "decharge",
        "descarga",
        "scarica",
        "放电",
    ]
)
_CHARGE = frozenset(["c", "chg", "chrg", "cha", "charge", "charging", "laden", "ladung", "carga", "carica", "充电"])
_CHINESE_DIRECTION = re.compile("[放充]电")
"""Words for charge and discharge in Chinese, which is written without spaces."""

NO_NUMBER = frozenset({"", "-", "--", "---", "n/a", "#n/a", "na", "null", "unavailable", "unknown"})
"""Cells without a value, in addition to the words of ``measured``."""
MAX_TEXT_CHARACTERS = 40
"""Maximum length of a time stamp or state, and of an invalid cell in a message. Longer texts are cut off."""


class CellKind(Enum):
    """Kind of a column's cells."""

    NUMBER = "number"
    DURATION = "duration"
    DATE_TIME = "date and time"
    DAY_FIRST = "date and time, day first"
    DIRECTION = "direction"
    LABEL = "number or name"


DATES = frozenset({CellKind.DATE_TIME, CellKind.DAY_FIRST})
"""Kinds of cells that become Unix times."""


def parse_number(cell: str, *, decimal_comma: bool) -> float:
    """Parse a number; an empty cell, a dash, or a word such as nan, is NaN.

    Args:
        cell: The text. Spaces and apostrophes between groups of three digits are ignored, and commas, or points if
            ``decimal_comma`` is set.
        decimal_comma: The decimal separator is a comma.

    Raises:
        ValueError: The text is not a number.
    """
    cell = cell.strip()
    if cell.lower() in NO_NUMBER:
        return float("nan")
    cell = _GROUPING_SPACE.sub("", cell)
    if decimal_comma:
        cell = (cell.replace(".", "") if _GROUPED_BY_POINTS.fullmatch(cell) else cell).replace(",", ".")
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


def parse_date_time(cell: str, *, day_first: bool = False) -> float:
    """Return the Unix time of a date and time [s]; UTC if the text has no time zone, midnight if it has no time.

    Formats are ISO 8601, year first, and day first with periods or with the English name of the month. With slashes or hyphens,
    ``day_first`` selects the order of day and month.

    Raises:
        ValueError: The text is not a date.
    """
    cell = cell.strip()
    if named := _MONTH_NAME.match(cell):
        cell = f"{named[1]}.{_MONTHS.index(named[2].lower()) + 1}.{named[3]}{cell[named.end() :]}"
    match = _DATE_TIME.fullmatch(cell)
    if not match:
        return _unix_s(datetime.fromisoformat(cell))
    first, separator, second, third, hour, minute, seconds, fraction, am_pm = match.groups()
    if len(first) == 4:
        year, month, day = int(first), int(second), int(third)
    elif separator == "." or day_first:
        day, month, year = int(first), int(second), int(third)
    else:
        month, day, year = int(first), int(second), int(third)
    hours = int(hour) % 12 + 12 * (am_pm.upper() == "PM") if am_pm else int(hour or 0)
    if year < 100:  # two digits
        year += 2000
    whole = datetime(year, month, day, hours, int(minute or 0), int(seconds or 0), tzinfo=UTC)
    return whole.timestamp() + (float(f"0.{fraction[1:]}") if fraction else 0.0)


def _unix_s(moment: datetime) -> float:
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def parse_direction(cell: str) -> float:
    """Return 1 for a text with a word for discharge, -1 with a word for charge, and 0 for other texts, such as rest or pause."""
    words = {word.lower() for word in _WORD.findall(cell)} | {*_CHINESE_DIRECTION.findall(cell)}
    return 1.0 if words & _DISCHARGE else -1.0 if words & _CHARGE else 0.0


def parse_label(cell: str) -> float:
    """Return the number of a device, or a negative number that stands for its name."""
    text = cell.strip()[:MAX_TEXT_CHARACTERS]
    try:
        return parse_number(text, decimal_comma=False)
    except ValueError:
        return -1.0 - zlib.crc32(text.encode(errors="replace"))


def uses_decimal_comma(cells: list[str]) -> bool:
    """Return True if cells have a comma where a decimal point would be, and none has a point except between groups of digits."""
    numbers = [_GROUPING_SPACE.sub("", cell.strip()) for cell in cells]
    is_grouped = [_GROUPED_BY_POINTS.fullmatch(number) is not None for number in numbers]
    return any(is_grouped) or (
        any(map(_DECIMAL_COMMA.fullmatch, numbers)) and not any("." in number for number in numbers)
    )


def time_kind(cells: Iterable[str]) -> CellKind:
    """Return the kind of the cells in a time column. An unknown kind counts as a number, whose parser reports the error."""
    remaining = iter(cells)
    cell = next(remaining, "")
    for kind in (CellKind.NUMBER, CellKind.DURATION, CellKind.DATE_TIME, CellKind.DAY_FIRST):
        try:
            parser(kind, decimal_comma="," in cell)(cell)
        except (ValueError, OverflowError):
            continue
        return kind if kind not in DATES else date_order(itertools.chain([cell], remaining))
    return CellKind.NUMBER


def date_order(cells: Iterable[str]) -> CellKind:
    """Return the kind of date-times, whose order of day and month is the same in all cells.

    A number above 12 shows the order. Otherwise the order with the shorter steps between the dates is returned, and month first
    for dates of a single day.
    """
    dates = dict[str, None]()
    for cell in cells:
        match = _DATE_TIME.fullmatch(cell.strip())
        if not match or match[2] == "." or len(match[1]) == 4 or int(match[3]) > 12:
            return CellKind.DATE_TIME
        if int(match[1]) > 12:
            return CellKind.DAY_FIRST
        dates[f"{match[1]}/{match[3]}/{match[4]}"] = None
    try:
        lengths_s = [
            sum(abs(after - before) for before, after in itertools.pairwise(map(parse, dates)))
            for parse in (parse_date_time, partial(parse_date_time, day_first=True))
        ]
    except ValueError:
        return CellKind.DATE_TIME
    return CellKind.DAY_FIRST if lengths_s[1] < lengths_s[0] else CellKind.DATE_TIME


def parser(kind: CellKind, *, decimal_comma: bool) -> Callable[[str], float]:
    """Return the function that converts the cells of a column; it raises ValueError or OverflowError."""
    if kind is CellKind.NUMBER:
        return partial(parse_number, decimal_comma=decimal_comma)
    parsers: dict[CellKind, Callable[[str], float]] = {
        CellKind.DURATION: parse_duration,
        CellKind.DATE_TIME: parse_date_time,
        CellKind.DAY_FIRST: partial(parse_date_time, day_first=True),
        CellKind.DIRECTION: parse_direction,
        CellKind.LABEL: parse_label,
    }
    return parsers[kind]
