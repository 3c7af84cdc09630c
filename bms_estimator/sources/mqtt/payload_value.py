"""Number from an MQTT payload: a plain number, or JSON and a path in it."""

import json
import math
import re
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Any

from bms_estimator.model.decimal_text import number
from bms_estimator.settings.sources.mqtt import ValueLocation

MAX_SHOWN_CHARACTERS = 40
"""Maximum number of characters of an invalid number that are shown."""
MAX_CELL_NUMBER = 400
"""Highest cell number in a path or topic."""
MAX_INDEX_DIGITS = 9
"""Number of digits of a list index that are converted, because ``int`` rejects very long texts. No list has a longer index."""
NO_VALUE = frozenset(("", "null", "none", "nan", "unavailable", "unknown"))
"""Texts with which publishers report a sensor without a value, in lower case."""
CELL_PLACEHOLDER = re.compile(r"\{cell\}")


class InvalidValueError(Exception):
    """The payload has no valid value of the quantity; the message gives the reason."""

    counter = "no_number"
    """Name of the counter of these errors."""


class MissingError(InvalidValueError):
    """The payload is JSON, but the path does not exist in it."""

    counter = "missing"


class NullError(InvalidValueError):
    """The payload says that there is no value."""

    counter = "missing"


def cell_pattern(text: str) -> re.Pattern[str]:
    """Return the pattern of a topic or key with ``{cell}``; the cell's number is its only group."""
    return re.compile(r"0*([0-9]{1,3})".join(map(re.escape, CELL_PLACEHOLDER.split(text))))


def read_value(payload: bytes, location: ValueLocation, path: str) -> float:
    """Return the quantity in SI units.

    Raises:
        InvalidValueError: The payload has no such value, or it is not a finite number.
    """
    return _to_si(_value_at(_parse(payload, path), path), location)


def read_cells(payload: bytes, location: ValueLocation, path: str) -> dict[int, float]:
    """Return the cell voltages by cell number, beginning with 1.

    The path leads to a list, or contains ``{cell}`` in place of the number. A cell without a valid value is NaN.

    Raises:
        InvalidValueError: No cell has a valid value.
    """
    found = dict(_iter_cells(_parse(payload, path), path))
    cells = {}
    for cell, value in found.items():
        try:
            cells[cell] = _to_si(value, location)
        except InvalidValueError:
            cells[cell] = math.nan
    if all(map(math.isnan, cells.values())):
        raise InvalidValueError(f"{path or 'payload'}: no cells in {_shorten(payload.decode('utf-8', 'replace'))}")
    return cells


def _iter_cells(value: Any, path: str) -> Iterator[tuple[int, Any]]:
    """Yield the number and the value of each cell."""
    before, placeholder, after = path.partition("{cell}")
    if not placeholder:
        listed = _value_at(value, path)
        if not isinstance(listed, list):
            raise InvalidValueError(f"{path or 'payload'}: no list of cells: {_shorten(listed)}")
        yield from enumerate(listed[:MAX_CELL_NUMBER], start=1)
        return
    *keys_above, key_prefix = before.split(".")
    key_suffix, *keys_below = after.split(".")
    parent = _value_at(value, ".".join(keys_above))
    keys = parent if isinstance(parent, dict) else ()
    pattern = cell_pattern(f"{key_prefix}{{cell}}{key_suffix}")
    for key in keys:
        match = pattern.fullmatch(key)
        if match and 1 <= int(match[1]) <= MAX_CELL_NUMBER:
            yield int(match[1]), _value_at(parent[key], ".".join(keys_below))


def _parse(payload: bytes, path: str) -> Any:
    """Return the parsed JSON; without a path, the payload as text."""
    try:
        text = payload.decode()
        return json.loads(text, parse_constant=str) if path else text  # NaN and Infinity become text
    except (ValueError, RecursionError):  # UnicodeDecodeError and JSONDecodeError are subclasses
        fault = "no JSON" if path else "no text"
        raise InvalidValueError(f"{fault}: {_shorten(payload.decode('utf-8', 'replace'))}") from None


def _value_at(value: Any, path: str) -> Any:
    """Return the value at a path.

    Raises:
        MissingError: The path does not exist.
    """
    for key in path.split(".") if path else ():
        if isinstance(value, dict) and key in value:
            value = value[key]
        elif isinstance(value, list) and key.isascii() and key.isdigit() and int(key[:MAX_INDEX_DIGITS]) < len(value):
            value = value[int(key)]
        else:
            raise MissingError(f"{path}: not in {_shorten(value)}")
    return value


def _to_si(value: Any, location: ValueLocation) -> float:
    if value is None or (isinstance(value, str) and value.strip().lower() in NO_VALUE):
        raise NullError(f"no number: {_shorten(value)}")
    if location.unit == "iso":
        return _epoch_s(value)
    try:
        found = number(value) if isinstance(value, str) else value
        if isinstance(found, bool) or not isinstance(found, int | float) or not math.isfinite(found):
            raise InvalidValueError(f"no number: {_shorten(value)}")
        value_si = location.to_si(float(found))
    except (ValueError, OverflowError):
        raise InvalidValueError(f"no number: {_shorten(value)}") from None
    if not math.isfinite(value_si):
        raise InvalidValueError(f"no number: {_shorten(value)}")
    return value_si


def _epoch_s(value: Any) -> float:
    """Convert an ISO 8601 time to s since 1970; a time without zone is UTC."""
    try:
        moment = datetime.fromisoformat(value)
        return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
    except (ValueError, TypeError, OverflowError):
        raise InvalidValueError(f"no time: {_shorten(value)}") from None


def _shorten(value: Any) -> str:
    text = repr(value)
    return text[:MAX_SHOWN_CHARACTERS] + ("..." if len(text) > MAX_SHOWN_CHARACTERS else "")
