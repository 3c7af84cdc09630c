"""Readings from samples of aiobmsble, and settings of a Bluetooth source.

The samples are those of aiobmsble's tests of JBD and Jikong BMS.
"""

import math
import sys
from types import SimpleNamespace

import pytest
from pydantic import ValidationError

from bms_estimator.model.errors import UserError
from bms_estimator.protocols.base.reading import Reading
from bms_estimator.settings.pack import Settings
from bms_estimator.sources.bluetooth.bms_sample import convert_sample
from bms_estimator.sources.bluetooth.source import MIN_PYTHON_HEX
from bms_estimator.sources.factory import open_source


class Sensor:
    """Replacement of aiobmsble's ``TempSensor``: a temperature and the place of its sensor."""

    def __init__(self, value: float, place: str = "GENERIC") -> None:
        self.value, self.type = value, SimpleNamespace(name=place)  # aiobmsble's type is an enum

    def __float__(self) -> float:
        return self.value


JBD = {
    "voltage": 15.6,
    "current": -2.87,
    "battery_level": 100,
    "temperature": 22.133,
    "power": -44.772,
    "battery_charging": False,
    "cell_count": 4,
    "cell_voltages": [3.43, 3.425, 3.432, 3.417],
    "temp_values": [Sensor(22.4), Sensor(22.3), Sensor(21.7)],
    "problem": False,
}
"""Sample of a JBD BMS during discharge."""


def test_current_of_a_reading_is_positive_on_charge() -> None:
    reading = convert_sample(JBD)
    assert reading is not None
    expected = Reading(
        voltage_v=15.6,
        current_a=-2.87,
        temperatures_c=(22.133,),
        cells_v=(3.43, 3.425, 3.432, 3.417),
        time_s=0.0,
        soc=1.0,
        remaining_ah=0.0,
        capacity_ah=0.0,
    )
    # NaN in place of a value that is not reported
    assert reading._replace(time_s=0.0, remaining_ah=0.0, capacity_ah=0.0) == expected
    settings = Settings.model_validate({"source": {"kind": "ble", "name": "DP04S007L4S100A"}})
    assert settings.sensor.current_sign == "charge_positive"


def test_temperatures_are_those_of_the_sensors_on_cells() -> None:
    sensors = [Sensor(18.1, "CELL"), Sensor(18.3, "CELL"), Sensor(31.0, "MOSFET")]
    reading = convert_sample(JBD | {"temp_values": sensors})
    assert reading is not None
    assert reading.temperatures_c == (18.1, 18.3)


@pytest.mark.parametrize("sensors", [[18.0, 19.0], []])
def test_without_sensors_on_cells_and_a_temperature_of_the_bms_all_sensors_are_used(sensors: list[float]) -> None:
    reading = convert_sample({"voltage": 13.2, "current": 0, "temp_values": sensors})
    assert reading is not None
    assert reading.temperatures_c == tuple(sensors)
    assert reading.cells_v == ()


@pytest.mark.parametrize(
    "sample", [{}, {"voltage": 13.2}, {"current": 1.0}, JBD | {"voltage": math.nan}, JBD | {"current": None}]
)
def test_sample_without_voltage_or_current_is_rejected(sample: dict[str, object]) -> None:
    assert convert_sample(sample) is None


@pytest.mark.parametrize("options", [{}, {"name": "a", "address": "A4:C1:38:00:11:22"}, {"address": "A4C138001122"}])
def test_invalid_settings_are_rejected(options: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        Settings.model_validate({"source": {"kind": "ble"} | options})


@pytest.mark.skipif(sys.hexversion >= MIN_PYTHON_HEX, reason="this Python is new enough")
def test_old_python_is_rejected_with_the_needed_version() -> None:
    with pytest.raises(UserError, match=r"needs Python 3\.12 or newer; this is 3\."):
        open_source(Settings.model_validate({"source": {"kind": "ble", "name": "a"}}))
