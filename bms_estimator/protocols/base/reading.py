"""Reading of a device, and parser of printed lines: columns, key=value or JSON."""

import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from math import nan
from typing import NamedTuple

from bms_estimator.model.decimal_text import NUMBER, measured, number

CONNECTED = b""
"""Empty line with which a line producer reports that it is connected."""


class Reading(NamedTuple):
    """Measured values of one moment."""

    voltage_v: float
    current_a: float
    """Current with the device's sign [A]."""
    temperatures_c: tuple[float, ...] = ()
    """Temperatures of all probes, always in the same order; NaN: absent or not reported [C]."""
    cells_v: tuple[float, ...] = ()
    time_s: float = nan
    """Timestamp by the device's clock, with any origin [s]; NaN: not reported."""
    voltage_held: bool = False
    """True if the voltage repeats an earlier reading, and only the other values are new."""
    current_held: bool = False
    """True if the current repeats an earlier reading, and only the other values are new."""
    soc: float = nan
    """State of charge by the device, 0..1; NaN: not reported."""
    remaining_ah: float = nan
    """Remaining charge by the device [Ah]; NaN: not reported."""
    capacity_ah: float = nan
    """Capacity from which the device computes its SOC [Ah]; NaN: not reported."""


VOLTAGE_HELD, CURRENT_HELD = "voltage_held", "current_held"
"""Names of the marks of a held voltage and a held current in a line."""
_VOLT: Mapping[str, float] = {"": 1.0, "v": 1.0, "volt": 1.0, "volts": 1.0, "mv": 1e-3}
_UNITS: Mapping[str, Mapping[str, float]] = {
    "voltage_v": _VOLT,
    "current_a": {"": 1.0, "a": 1.0, "amp": 1.0, "amps": 1.0, "ma": 1e-3},
    "temperature_c": {"": 1.0, "c": 1.0, "degc": 1.0},
    "temperatures_c": {"": 1.0, "c": 1.0, "degc": 1.0},
    "time_s": {"s": 1.0},
    VOLTAGE_HELD: {"": 1.0},  # 1: held, 0: measured
    CURRENT_HELD: {"": 1.0},
    "cells_v": _VOLT,
    "device_soc": {"": 1.0},
    "device_capacity_ah": {"ah": 1.0},
}
_NAMES = {
    "voltage_v": ("V", "v", "U", "u", "volt", "volts", "voltage", "vbat", "vbatt", "bus_voltage", "pack_voltage"),
    "current_a": ("I", "i", "A", "amp", "amps", "current", "ibat", "ibatt"),
    "temperature_c": ("T", "temp", "temperature"),  # t may be the time
    "temperatures_c": ("temperatures",),
    "time_s": ("time",),  # only with its unit, because boards print times in any unit
    VOLTAGE_HELD: (VOLTAGE_HELD,),
    CURRENT_HELD: (CURRENT_HELD,),
    "cells_v": ("cells", "cell_voltages"),
    "device_soc": ("device_soc",),
    "device_capacity_ah": ("device_capacity",),
}
_QUANTITIES = {
    f"{name}_{unit}" if unit else name: (field, unit)
    for field, names in _NAMES.items()
    for name in names
    for unit in _UNITS[field]
}
"""Quantity, and unit if the name contains one, by name in a line."""

_LISTS = ("cells_v", "temperatures_c")
"""Quantities with any number of values."""
_SEPARATORS = bytes.maketrans(b",;\t", b"   ")
_PAIR = re.compile(
    r"(?<![A-Za-z0-9_])([A-Za-z_][A-Za-z0-9_]*)\s*[=:]\s*"
    rf"({NUMBER}(?:,{NUMBER})*)"
    r"(?:\s*([A-Za-z]{1,8})\b(?!\s*[=:]))?"  # a unit, unless it is the next name
    r"(?!\w|\.\d|,[-+.\d])"  # a partial number is not valid
)


def read_line(line: bytes) -> Reading | None:
    """Parse a line; None if it has no voltage and current.

    Examples: ``13.3,2.0`` or ``13.3 2.0 25`` (volts, amperes, degrees Celsius), ``13,3;2,0`` (commas in its numbers),
    ``V=13.3 I=2000mA T=25 cells=3.32,3.33``, ``V=13.3 I=2 temperatures=25,26`` (several probes), ``Voltage: 13.3 V, Current: 2 A``, ``{"voltage": 13.3, "current": 2}``.
    ``time_s`` is the board's timestamp. ``voltage_held=1`` and ``current_held=1`` mark a value of an earlier line. A cell that is ``null``
    was not measured. Unknown names are skipped. A repeated name or an unknown unit makes the line invalid.
    """
    if b";" in line and b"." not in line:
        line = line.replace(b",", b".")
    try:
        if line.lstrip().startswith(b"{"):
            return _to_reading(_json_values(line))
        if b"=" in line or b":" in line:
            return _to_reading(_pair_values(line.decode("ascii", "replace")))
        columns = line.translate(_SEPARATORS).decode("ascii").split()
        if len(columns) not in (2, 3):
            return None
        return Reading(number(columns[0]), number(columns[1]), tuple(measured(column) for column in columns[2:]))
    except (ValueError, TypeError, OverflowError, RecursionError):
        return None


_NamedValues = tuple[str, list[float], str]
"""Name, values, unit or an empty string."""


def _pair_values(text: str) -> Iterable[_NamedValues]:
    for name, values, unit in _PAIR.findall(text):
        yield name, [number(value) for value in values.split(",")], unit


def _json_values(line: bytes) -> Iterable[_NamedValues]:
    for name, value in json.loads(line.decode(), parse_float=number, parse_constant=number).items():
        values = [nan if v is None else v for v in value] if isinstance(value, list) else [value]
        if name in (VOLTAGE_HELD, CURRENT_HELD) or all(
            isinstance(v, int | float) and not isinstance(v, bool) for v in values
        ):
            yield name, [float(v) for v in values], ""


def _to_reading(named_values: Iterable[_NamedValues]) -> Reading | None:
    """Combine named values to a reading; None without voltage or current.

    Raises:
        ValueError: A name is duplicated, or has an unknown unit or the wrong number of values.
    """
    values_si: dict[str, list[float]] = {}
    for name, values, unit in named_values:
        field, named_unit = _QUANTITIES.get(name) or _QUANTITIES.get(name.lower()) or ("", "")
        if not field:
            continue
        factor = _UNITS[field].get((unit or named_unit).lower())
        if factor is None or field in values_si or (field not in _LISTS and len(values) != 1):
            raise ValueError(name)
        values_si[field] = [factor * value for value in values]
    if "voltage_v" not in values_si or "current_a" not in values_si:
        return None
    voltage_v, current_a, time_s, soc, capacity_ah = (
        values_si.get(field, [nan])[0]
        for field in ("voltage_v", "current_a", "time_s", "device_soc", "device_capacity_ah")
    )
    temperatures_c = tuple(values_si.get("temperatures_c", values_si.get("temperature_c", ())))
    cells_v = tuple(values_si.get("cells_v", ()))
    voltage_held, current_held = (values_si.get(name, [0.0])[0] > 0.0 for name in (VOLTAGE_HELD, CURRENT_HELD))
    return Reading(
        voltage_v,
        current_a,
        temperatures_c,
        cells_v,
        time_s,
        voltage_held,
        current_held,
        soc=soc,
        capacity_ah=capacity_ah,
    )


def sample_json_line(
    voltage_v: float,
    current_a: float,
    *,
    temperatures_c: Sequence[float | None] = (),
    cells_v: Sequence[float | None] = (),
    time_s: float | None = None,
    voltage_held: bool = False,
    current_held: bool = False,
    soc: float = nan,
    capacity_ah: float = nan,
) -> bytes:
    """Return the JSON line of one sample.

    Args:
        voltage_v: Voltage of the pack's terminals [V].
        current_a: Current with the device's sign, see ``sensor.current_sign`` [A].
        temperatures_c: Temperatures of the probes, always in the same order; None or NaN: not measured [degC].
        cells_v: Cell voltages, from the first on; None or NaN: not measured [V].
        time_s: Timestamp by the device's clock, with any origin [s]; None: not reported.
        voltage_held: True if the voltage repeats an earlier sample.
        current_held: True if the current repeats an earlier sample.
        soc: SOC by the device, 0..1; NaN: not reported.
        capacity_ah: Capacity from which the device computes its SOC [Ah]; NaN: not reported.

    Raises:
        ValueError: Voltage or current is not finite.
    """
    if not (math.isfinite(voltage_v) and math.isfinite(current_a)):
        raise ValueError(f"no sample: {voltage_v} V, {current_a} A")
    line: dict[str, object] = {"voltage_v": round(voltage_v, 6), "current_a": round(current_a, 6)}
    probes_c = [_rounded(probe_c, 3) for probe_c in temperatures_c]
    if len(probes_c) > 1:
        line["temperatures_c"] = probes_c
    elif probes_c and probes_c[0] is not None:
        line["temperature_c"] = probes_c[0]
    if time_s is not None and math.isfinite(time_s):
        line["time_s"] = round(time_s, 6)
    if voltage_held:
        line[VOLTAGE_HELD] = 1
    if current_held:
        line[CURRENT_HELD] = 1
    for name, value in (("device_soc", soc), ("device_capacity_ah", capacity_ah)):
        if math.isfinite(value):
            line[name] = round(value, 4)
    if cells_v:
        line["cells_v"] = [_rounded(v, 4) for v in cells_v]
    return json.dumps(line, separators=(",", ":")).encode() + b"\n"


def _rounded(value: float | None, digits: int) -> float | None:
    """Return the rounded value; None without a finite one."""
    return round(value, digits) if value is not None and math.isfinite(value) else None
