"""Units of columns, and column names that contain a unit, such as ``Current(mA)``, ``Ewe/V`` or ``time_s``."""

import re
from typing import Literal, NamedTuple

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
