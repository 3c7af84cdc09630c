"""``kind = "ble"``: a BMS over Bluetooth. It checks the Python version before it imports the client.

The readings of the samples of aiobmsble are here, because the client needs an optional package.
"""

import math
import sys
from collections.abc import Mapping
from typing import Any

from bms_estimator.model.errors import UserError
from bms_estimator.protocols.base.reading import Reading
from bms_estimator.settings.pack import Settings
from bms_estimator.settings.sources.ble import BleSource
from bms_estimator.sources.line_source import LineProducer

MIN_PYTHON_HEX = 0x030C0000
"""Minimum Python version of aiobmsble, 3.12, in the format of ``sys.hexversion``."""


def producer(settings: Settings) -> LineProducer:
    """Make the line producer of ``[source]``.

    Raises:
        UserError: This Python is too old, or aiobmsble does not support this BMS.
        ModuleNotFoundError: aiobmsble is not installed.
    """
    assert isinstance(settings.source, BleSource)  # noqa: S101 - KINDS maps kind = "ble" to BleSource
    if sys.hexversion < MIN_PYTHON_HEX:
        raise UserError(f'source.kind = "ble" needs Python 3.12 or newer; this is {sys.version.split()[0]}')
    from bms_estimator.sources.bluetooth.client import BleProducer  # noqa: PLC0415 - needs Python 3.12 and an extra

    return BleProducer(settings.source)


def convert_sample(sample: Mapping[str, Any]) -> Reading | None:
    """Return the reading of aiobmsble's ``BMSSample``, positive on charge; None without voltage or current."""
    voltage_v, current_a = _number(sample.get("voltage")), _number(sample.get("current"))
    if math.isnan(voltage_v) or math.isnan(current_a):
        return None
    cells_v = tuple(_number(cell) for cell in sample.get("cell_voltages", ()))
    soc, capacity_ah = _number(sample.get("battery_level")) / 100.0, _number(sample.get("design_capacity"))
    return Reading(voltage_v, current_a, _temperatures_c(sample), cells_v, soc=soc, capacity_ah=capacity_ah)


def _temperatures_c(sample: Mapping[str, Any]) -> tuple[float, ...]:
    """Return the temperatures of the sensors on cells [degC].

    Without such sensors return the temperature of the BMS, or those of all sensors.
    """
    sensors = sample.get("temp_values", ())
    on_cells = [sensor for sensor in sensors if getattr(getattr(sensor, "type", None), "name", "") == "CELL"]
    if not on_cells and "temperature" in sample:
        return (_number(sample["temperature"]),)
    return tuple(map(_number, on_cells or sensors))


def _number(value: Any) -> float:
    """Convert a value to a finite float; NaN if it is not one."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        return math.nan
    return number if math.isfinite(number) else math.nan
