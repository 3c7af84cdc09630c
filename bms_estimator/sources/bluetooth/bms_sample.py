"""Conversion of aiobmsble's samples to readings. This module does not import the optional package."""

import math
from collections.abc import Mapping
from typing import Any

from bms_estimator.protocols.base.reading import Reading


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
