"""Values of cells, and units of columns: numbers with decimal point or comma, durations, date-times, and words for charge and discharge."""

import itertools
import re
import zlib
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from enum import Enum
from functools import partial
from typing import Literal, NamedTuple

from bms_estimator.model.decimal_text import measured

Quantity = Literal["time", "current", "voltage", "temperature"]


class Unit(NamedTuple):
    """Unit of a column. The value in the SI unit (for a temperature: °C) is ``factor * value + offset``."""

    symbol: str
    factor: float = 1.0
    offset: float = 0.0


SI_UNITS: dict[Quantity, Unit] = {
    "time": Unit("s"),
    "current": Unit("A"),
    "voltage": Unit("V"),
    "temperature": Unit("°C"),
}
"""Units of a sample, assumed for columns that state none."""

_SPELLINGS: dict[Quantity, dict[Unit, str]] = {
    "time": {
        SI_UNITS["time"]: "s sec secs second seconds sek",
        Unit("ms", 1e-3): "ms millisecond milliseconds",
        Unit("µs", 1e-6): "us microsecond microseconds",
        Unit("ns", 1e-9): "ns nanosecond nanoseconds",
        Unit("min", 60.0): "min mins minute minutes",
        Unit("h", 3600.0): "h hr hrs hour hours",
        Unit("d", 86_400.0): "d day days",
    },
    "current": {
        SI_UNITS["current"]: "a amp amps ampere amperes",
        Unit("mA", 1e-3): "ma mamp mamps milliampere milliamperes",
        Unit("µA", 1e-6): "ua microampere microamperes",
    },
    "voltage": {
        SI_UNITS["voltage"]: "v volt volts",
        Unit("mV", 1e-3): "mv mvolt mvolts millivolt millivolts",
        Unit("µV", 1e-6): "uv microvolt microvolts",
    },
    "temperature": {
        SI_UNITS["temperature"]: "c degc celsius",
        Unit("K", 1.0, -273.15): "k degk kelvin",
        Unit("°F", 5.0 / 9.0, -160.0 / 9.0): "f degf fahrenheit",
    },
}
_UNITS = {
    quantity: {word: unit for unit, words in spellings.items() for word in words.split()}
    for quantity, spellings in _SPELLINGS.items()
}
TIME_UNITS = tuple(_SPELLINGS["time"])
"""Units of a time."""
_UNIT_WORDS = frozenset(word for units in _UNITS.values() for word in units)
_CHARACTERS = str.maketrans(
    {"µ": "u", "μ": "u", "°": "deg", "º": "deg", "℃": "c", "Â": None, "\ufffd": "deg", " ": None, "_": None}
)
"""Replacements before a unit is looked up. UTF-8 that was read as latin-1 leaves ``Â``; a lost ``°`` leaves U+FFFD."""
_GBK_CELSIUS = "¡æ"
"""Character ℃ in the Chinese encoding GBK, read as latin-1."""
_STAMP = re.compile(r"[:\-].*s|y{2,4}.*m", re.IGNORECASE)
"""Pattern of a format of time stamps, such as ``h:min:s.ms`` or ``yyyy-mm-dd``."""
_REFERENCE = re.compile(r"\s+vs\b.*", re.IGNORECASE)
"""Reference electrode after a unit, as in ``V vs. Ref.``."""
_BRACKETED = re.compile(r"(?P<name>[^()\[\]]+)[(\[](?P<unit>[^()\[\]]*)[)\]]\s*")
_SEPARATED = re.compile(r"(?P<name>.+)[/#](?P<unit>[^/#]+)")
_LAST_WORD = re.compile(r"(?P<name>.+)[_ ](?P<unit>[^_ ]+)")
_IGNORED = re.compile(r"[\s_.~/\-]+|\[\d+\](?=.)")
_NOT_UNITS = frozenset({"time", "date", "zeit"})
"""Words after a slash that belong to the name, as in ``Date/Time``."""


class ColumnName(NamedTuple):
    """Name of a column in the form in which names are compared, and its unit as text."""

    name: str
    unit: str | None
    full_name: str
    """Name with the unit, which belongs to the name in headers such as ``Pack Volts``."""


def fold(name: str) -> str:
    """Return a name in lower case, without spaces, the characters ``_``, ``-``, ``.``, ``/`` and ``~``, and numbers of devices.

    The number of a device is in square brackets between other words, as in ``Battery Monitor [279] Voltage``.
    """
    return _IGNORED.sub("", name.lower())


def split_unit(header: str) -> ColumnName:
    """Return the folded name in a header, and its unit or None. A header such as ``Volts`` is both name and unit."""
    text = header.strip()
    for pattern in (_BRACKETED, _SEPARATED, _LAST_WORD):
        match = pattern.fullmatch(text)
        if not match or match["unit"].strip().lower() in _NOT_UNITS:
            continue
        if pattern is not _LAST_WORD or match["unit"].lower() in _UNIT_WORDS:
            return ColumnName(fold(match["name"]), match["unit"].strip(), fold(text))
    return ColumnName(fold(text), text if text.lower() in _UNIT_WORDS else None, fold(text))


def find_unit(quantity: Quantity, text: str) -> Unit | None:
    """Return the unit that a text names; None if it names no unit of this quantity."""
    text = text.strip().strip("()[]")
    if quantity == "time" and _STAMP.search(text):
        return SI_UNITS["time"]
    if quantity == "temperature" and text == _GBK_CELSIUS:
        return SI_UNITS["temperature"]
    if quantity == "voltage":
        text = _REFERENCE.sub("", text)
    return _UNITS[quantity].get(text.translate(_CHARACTERS).lower())


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
