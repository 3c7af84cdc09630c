"""Profiles of battery projects that publish over MQTT: defaults of ``[source]`` by the project's name.

``{prefix}`` is ``source.prefix``, ``{instance}`` is ``source.instance``, ``{cell}`` is the number of a cell and ``{probe}`` that of
a temperature probe, both from 1. Explicit settings take precedence over a profile. A comment above each profile names the files
from which it was taken in November 2026.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

ProfileName = Literal[
    "batmon-ha",
    "esphome-jk",
    "esphome-jbd",
    "esphome-daly",
    "venus",
    "battery-emulator",
    "opendtu",
    "tasmota",
    "zigbee2mqtt",
]
CHARGE, DISCHARGE = "charge_positive", "discharge_positive"
"""Direction of positive current."""


class Profile(NamedTuple):
    """Defaults of one project."""

    table: Mapping[str, Any]
    """Defaults of ``[source]``."""
    current_sign: str
    """Direction of positive current, the default of ``sensor.current_sign``."""
    voltage_resolution_v: float
    current_resolution_a: float
    protocol: str = ""
    """Serial protocol of the same BMS, which defines the dead band of the current; empty: no dead band is known."""
    required_settings: Mapping[str, str] = {}
    """Descriptions of the settings without which the profile is incomplete, by name."""


_VENUS_TEMPERATURES = ("Dc/0/Temperature", "System/MinCellTemperature", "System/MaxCellTemperature")
"""Paths of temperatures of a battery on Venus OS. A battery without cells has only the first."""


def _esphome_defaults(
    voltage: str, current: str, temperature: Sequence[str], cell: str, soc: str, capacity: str = ""
) -> dict[str, Any]:
    """Return the defaults of an ESPHome node.

    Its topics are ``<topic_prefix>/sensor/<object_id>/state`` with a plain number as payload
    (esphome/components/mqtt/mqtt_component.cpp). The object id is the sensor's name. In the examples of the projects
    this name begins with the name of the node, which is the prefix unless ``instance`` is set. Sensor names without
    the node's name are accepted too.

    Args:
        voltage: Name of the sensor of the pack voltage.
        current: Name of the sensor of the current.
        temperature: Names of the sensors of the temperature, which may contain ``{probe}``.
        cell: Name of the sensors of the cell voltages, with ``{cell}``.
        soc: Name of the sensor of the SOC.
        capacity: Name of the sensor of the configured capacity; empty without one.
    """

    def topics(name: str) -> dict[str, Any]:
        return {"topic": [f"{{prefix}}/sensor/{node}{name}/state" for node in ("{prefix}_", "{instance}_", "")]}

    return {
        "voltage": topics(voltage),
        "current": topics(current),
        "temperature": [topics(name) for name in temperature],
        "cells": topics(cell),
        "soc": topics(soc),
        **({"capacity": topics(capacity)} if capacity else {}),
        "availability_topic": "{prefix}/status",
    }


def _required_prefix(example: str) -> dict[str, str]:
    """Return the description of the required setting ``prefix`` of an ESPHome node."""
    return {"prefix": f"mqtt.topic_prefix of the node, else its name, such as {example}"}


PROFILES: Mapping[ProfileName, Profile] = {
    # bmslib/mqtt_util.py, bmslib/wire/fields.py; sign: issue 10. Unchanged values are published only every 10 s.
    "batmon-ha": Profile(
        {
            "voltage": {"topic": "{prefix}/soc/total_voltage"},
            "current": {"topic": "{prefix}/soc/current"},
            "temperature": {"topic": "{prefix}/temperatures/{probe}"},
            "cells": {"topic": "{prefix}/cell_voltages/{cell}"},
            "soc": {"topic": "{prefix}/soc/soc_percent"},
            "capacity": {"topic": "{prefix}/soc/capacity"},
            "interval_s": 10.0,
        },
        current_sign=DISCHARGE,
        voltage_resolution_v=0.01,  # four significant digits
        current_resolution_a=0.01,
        required_settings={"prefix": "alias or address of the device in its options"},
    ),
    # syssi/esphome-jk-bms, esp32-example.yaml and esp32-ble-example.yaml
    "esphome-jk": Profile(
        _esphome_defaults(
            "total_voltage",
            "current",
            ["temperature_sensor_{probe}"],
            "cell_voltage_{cell}",
            "state_of_charge",
            "total_battery_capacity_setting",
        ),
        current_sign=CHARGE,
        voltage_resolution_v=0.01,
        current_resolution_a=0.01,
        protocol="jk",
        required_settings=_required_prefix("jk-bms"),
    ),
    # syssi/esphome-jbd-bms, esp32-ble-example.yaml
    "esphome-jbd": Profile(
        _esphome_defaults(
            "total_voltage",
            "current",
            ["temperature_{probe}"],
            "cell_voltage_{cell}",
            "state_of_charge",
            "nominal_capacity",
        ),
        current_sign=CHARGE,
        voltage_resolution_v=0.01,
        current_resolution_a=0.01,
        protocol="jbd",
        required_settings=_required_prefix("jbd-bms-ble"),
    ),
    # ESPHome's daly_bms, with the sensor names and the interval of 20 s of its documentation. The sign is that of the
    # frame (esphome/components/daly_bms/daly_bms.cpp), as in protocols/devices/daly.py
    "esphome-daly": Profile(
        _esphome_defaults(
            "battery_voltage",
            "battery_current",
            ["max_temperature", "min_temperature"],
            "cell_{cell}_voltage",
            "battery_level",
        )
        | {"interval_s": 20.0},
        current_sign=DISCHARGE,
        voltage_resolution_v=0.1,
        current_resolution_a=0.1,
        protocol="daly",
        required_settings=_required_prefix("daly-bms"),
    ),
    # victronenergy/dbus-flashmq, README: values are published on change and on request; a keep-alive lasts 60 s.
    # Cell topics are those of dbus-serialbattery with BATTERY_CELL_DATA_FORMAT = 1.
    "venus": Profile(
        {
            "voltage": {"topic": "N/{prefix}/battery/{instance}/Dc/0/Voltage", "path": "value"},
            "current": {"topic": "N/{prefix}/battery/{instance}/Dc/0/Current", "path": "value"},
            "temperature": [
                {"topic": f"N/{{prefix}}/battery/{{instance}}/{path}", "path": "value"} for path in _VENUS_TEMPERATURES
            ],
            "cells": {"topic": "N/{prefix}/battery/{instance}/Voltages/Cell{cell}", "path": "value"},
            "soc": {"topic": "N/{prefix}/battery/{instance}/Soc", "path": "value"},
            "capacity": {"topic": "N/{prefix}/battery/{instance}/InstalledCapacity", "path": "value"},
            "ask": {
                "R/{prefix}/keepalive": '{"keepalive-options":["suppress-republish"]}',
                "R/{prefix}/battery/{instance}/Dc/0/Voltage": "",
                "R/{prefix}/battery/{instance}/Dc/0/Current": "",
                **{f"R/{{prefix}}/battery/{{instance}}/{path}": "" for path in _VENUS_TEMPERATURES},
                "R/{prefix}/battery/{instance}/Voltages": "",
                "R/{prefix}/battery/{instance}/Soc": "",
                "R/{prefix}/battery/{instance}/InstalledCapacity": "",
            },
            "ask_s": 2.0,
            "interval_s": 2.0,
        },
        current_sign=CHARGE,
        voltage_resolution_v=0.01,
        current_resolution_a=0.1,
        required_settings={
            "prefix": "VRM portal ID, in Settings, VRM online portal",
            "instance": "device instance of the battery, as in the topics N/<portal>/battery/<instance>/...",
        },
    ),
    # dalathegreat/Battery-Emulator, Software/src/devboard/mqtt/mqtt.cpp; sign: issue 342. Cells are sent each minute.
    "battery-emulator": Profile(
        {
            "prefix": "BE",
            "voltage": {"topic": "{prefix}/info{instance}", "path": "battery_voltage"},
            "current": {"topic": "{prefix}/info{instance}", "path": "battery_current"},
            "temperature": [
                {"topic": "{prefix}/info{instance}", "path": path} for path in ("temperature_max", "temperature_min")
            ],
            "cells": {"topic": "{prefix}/spec_data{instance}", "path": "cell_voltages"},
            "soc": {"topic": "{prefix}/info{instance}", "path": "SOC_real"},
            "availability_topic": "{prefix}/status",
        },
        current_sign=CHARGE,
        voltage_resolution_v=0.1,
        current_resolution_a=0.1,
    ),
    # hoylabs/OpenDTU-OnBattery, src/battery/Stats.cpp and src/battery/jkbms/Stats.cpp
    "opendtu": Profile(
        {
            "prefix": "solar",
            "voltage": {"topic": "{prefix}/battery/voltage"},
            "current": {"topic": "{prefix}/battery/current"},
            "temperature": [
                {"topic": ["{prefix}/battery/temperature", "{prefix}/battery/BatteryTempOneCelsius"]},
                {"topic": "{prefix}/battery/BatteryTempTwoCelsius"},
            ],
            "cells": {"topic": "{prefix}/battery/Cell{cell}MilliVolt", "unit": "mV"},
            "soc": {"topic": "{prefix}/battery/stateOfCharge"},
            "availability_topic": "{prefix}/dtu/status",
        },
        current_sign=CHARGE,
        voltage_resolution_v=0.01,
        current_resolution_a=0.01,
    ),
    # arendst/Tasmota, tasmota/tasmota_xdrv_driver: {"Time":...,"INA219":{"Voltage":4.494,"Current":0.020,"Power":0.089}}
    "tasmota": Profile(
        {
            "instance": "INA219",
            "voltage": {"topic": "tele/{prefix}/SENSOR", "path": "{instance}.Voltage"},
            "current": {"topic": "tele/{prefix}/SENSOR", "path": "{instance}.Current"},
            "availability_topic": "tele/{prefix}/LWT",
        },
        current_sign=DISCHARGE,
        voltage_resolution_v=0.01,
        current_resolution_a=0.01,
        required_settings={"prefix": "Topic of the device, Configuration, MQTT"},
    ),
    # zigbee2mqtt.io, MQTT topics and messages: {"voltage":52.1,"current":3.2,"power":167,"linkquality":34}
    "zigbee2mqtt": Profile(
        {
            "voltage": {"topic": "zigbee2mqtt/{prefix}", "path": "voltage"},
            "current": {"topic": "zigbee2mqtt/{prefix}", "path": "current"},
            "availability_topic": "zigbee2mqtt/{prefix}/availability",
            "interval_s": 60.0,
        },
        current_sign=DISCHARGE,
        voltage_resolution_v=0.1,
        current_resolution_a=0.01,
        required_settings={"prefix": "friendly name of the meter"},
    ),
}
