"""Number from an MQTT payload: a plain number, or JSON and a path in it."""

import json
import math
import re
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Any

from bms_estimator.model.decimal_text import number
from bms_estimator.settings.mqtt_source import ValueLocation

SHOWN = 40
"""Maximum number of characters of an invalid number that are shown."""
MAX_CELLS = 400
"""A path or topic may name no cell beyond."""
CELL = re.compile(r"\{cell\}")


class InvalidValueError(Exception):
    """A payload without the quantity; the message gives the reason."""

    kind = "no_number"
    """Under which it is counted."""


class MissingError(InvalidValueError):
    """The payload is JSON without the path."""

    kind = "missing"


def cell_pattern(text: str) -> re.Pattern[str]:
    """Return the pattern of a topic or key with ``{cell}``; the cell's number is its only group."""
    return re.compile(r"0*([0-9]{1,3})".join(map(re.escape, CELL.split(text))))


def read_value(payload: bytes, place: ValueLocation, path: str) -> float:
    """Read the quantity in SI units.

    Raises:
        InvalidValueError: It is not there, or no finite number.
    """
    return _si(_found(_parsed(payload, path), path), place)


def read_cells(payload: bytes, place: ValueLocation, path: str) -> dict[int, float]:
    """Cells by their numbers from 1.

    From a list, or from the values of ``{cell}`` in the path. A cell that has no number is NaN.

    Raises:
        InvalidValueError: There are no cells.
    """
    found = dict(_cells(_parsed(payload, path), path))
    cells = {}
    for cell, value in found.items():
        try:
            cells[cell] = _si(value, place)
        except InvalidValueError:
            cells[cell] = math.nan
    if all(map(math.isnan, cells.values())):
        raise InvalidValueError(f"{path or 'payload'}: no cells in {_shown(payload.decode('utf-8', 'replace'))}")
    return cells


def _cells(value: Any, path: str) -> Iterator[tuple[int, Any]]:
    before, cell, after = path.partition("{cell}")
    if not cell:
        listed = _found(value, path)
        if not isinstance(listed, list):
            raise InvalidValueError(f"{path or 'payload'}: no list of cells: {_shown(listed)}")
        yield from enumerate(listed[:MAX_CELLS], start=1)
        return
    *above, begin = before.split(".")
    end, *below = after.split(".")
    among = _found(value, ".".join(above))
    keys = among if isinstance(among, dict) else ()
    pattern = cell_pattern(f"{begin}{{cell}}{end}")
    for key in keys:
        match = pattern.fullmatch(key)
        if match and 1 <= int(match[1]) <= MAX_CELLS:
            yield int(match[1]), _found(among[key], ".".join(below))


def _parsed(payload: bytes, path: str) -> Any:
    try:
        text = payload.decode()
        return json.loads(text, parse_constant=str) if path else text
    except (ValueError, RecursionError):  # UnicodeDecodeError and JSONDecodeError are one
        what = "no JSON" if path else "no text"
        raise InvalidValueError(f"{what}: {_shown(payload.decode('utf-8', 'replace'))}") from None


def _found(value: Any, path: str) -> Any:
    """Return the value at a path.

    Raises:
        MissingError: It leads nowhere.
    """
    for key in path.split(".") if path else ():
        if isinstance(value, dict) and key in value:
            value = value[key]
        elif isinstance(value, list) and key.isascii() and key.isdigit() and int(key[:9]) < len(value):
            value = value[int(key)]
        else:
            raise MissingError(f"{path}: not in {_shown(value)}")
    return value


def _si(value: Any, place: ValueLocation) -> float:
    if place.unit == "iso":
        return _epoch_s(value)
    try:
        found = number(value) if isinstance(value, str) else value
        if isinstance(found, bool) or not isinstance(found, int | float) or not math.isfinite(found):
            raise InvalidValueError(f"no number: {_shown(value)}")
        made = place.si(float(found))
    except (ValueError, OverflowError):
        raise InvalidValueError(f"no number: {_shown(value)}") from None
    if not math.isfinite(made):
        raise InvalidValueError(f"no number: {_shown(value)}")
    return made


def _epoch_s(value: Any) -> float:
    """Time of ISO 8601, without a zone in UTC [s since 1970]."""
    try:
        moment = datetime.fromisoformat(value)
        return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
    except (ValueError, TypeError, OverflowError):
        raise InvalidValueError(f"no time: {_shown(value)}") from None


def _shown(value: Any) -> str:
    text = repr(value)
    return text[:SHOWN] + ("..." if len(text) > SHOWN else "")
