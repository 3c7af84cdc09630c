"""Home Assistant's device discovery: one retained message that describes all entities of one pack.

Home Assistant keeps a row for each change of each entity. So it gets topics of its own, rounded and slow
(``home_assistant_values``); what only a researcher looks at is there but disabled until he enables it.
"""

import math
from typing import Any, NamedTuple

from bms_estimator.model.estimate import Info
from bms_estimator.sinks import FRESH_PERIODS

BIRTH_TOPIC = "homeassistant/status"
"""Home Assistant says ``online`` here when it has started."""
VALUES, PROBLEMS = "home_assistant", "home_assistant/problems"
"""Topics below the device's."""
LEAST_EXPIRY_S = 30
"""Home Assistant calls no value unavailable that is younger than this [s]."""
QUICK_S = 15.0
"""What a load moves all the time is shown anew no more often than this: four rows a minute [s]."""
SLOW_S = 60.0
"""All other values [s]."""


class Entity(NamedTuple):
    """A number that Home Assistant shows."""

    name: str
    unit: str | None
    decimals: int
    """To which it is rounded."""
    step: float
    """It is shown anew when it has changed by so much, in its unit: what noise moves is less."""
    device_class: str | None = None
    pace_s: float = SLOW_S
    """Nor more often than this [s]."""
    main: bool = False
    """Else Home Assistant lists it among the diagnostics."""
    enabled: bool = True
    """Else the user enables it."""
    state_class: str = "measurement"


def _raw(name: str, unit: str | None, decimals: int, device_class: str | None = None) -> Entity:
    """What the observer looks like inside."""
    return Entity(name, unit, decimals, 10.0**-decimals, device_class, enabled=False)


ESTIMATE = {
    # by field of the estimate
    "voltage_v": Entity("Voltage", "V", 2, 0.02, "voltage", QUICK_S, main=True),
    "current_a": Entity("Current (discharge positive)", "A", 2, 0.05, "current", QUICK_S, main=True),
    "power_w": Entity("Power (discharge positive)", "W", 1, 0.5, "power", QUICK_S, main=True),
    "temperature_c": Entity("Temperature", "°C", 1, 0.3, "temperature", main=True),
    "soc_percent": Entity("State of charge", "%", 1, 0.2, "battery", main=True),
    "remaining_capacity_ah": Entity("Remaining capacity", "Ah", 2, 0.02, main=True),
    "remaining_energy_wh": Entity("Remaining energy", "Wh", 1, 0.2, "energy_storage", main=True),
    "time_to_empty_s": Entity("Time to empty", "s", 0, 60.0, "duration", main=True),
    "frames_lost": Entity("Frames lost", None, 0, 1.0, state_class="total_increasing"),
    "crc_errors": Entity("CRC errors", None, 0, 1.0, state_class="total_increasing"),
    "soc_std": _raw("State of charge, standard deviation", None, 3),
    "usable_capacity_ah": _raw("Usable capacity", "Ah", 2),
    "voltage_estimate_v": _raw("Estimated voltage", "V", 2, "voltage"),
    "innovation_v": _raw("Innovation", "V", 3, "voltage"),
    "stability_margin": _raw("Stability margin", None, 3),
    "delta_1": _raw("delta 1", None, 4),
    "delta_2": _raw("delta 2", None, 4),
    "adaptive_gain_k": _raw("Adaptive gain k", "V²s", 6),
    "nussbaum_gain": _raw("Nussbaum gain", None, 3),
    "sample_rate_hz": _raw("Sample rate", "Hz", 1, "frequency"),
}
ELEMENTS = {
    # by element of the parameters
    "r_s_ohm": Entity("R_s", "Ω", 4, 0.0005),
    "r_ts_ohm": _raw("R_ts", "Ω", 4),
    "r_tl_ohm": _raw("R_tl", "Ω", 4),
    "c_ts_farad": _raw("C_ts", "F", 0),
    "c_tl_farad": _raw("C_tl", "F", 0),
}
STACK = {
    # by element of the parameters of a fuel cell
    "r_ohm": Entity("Resistance", "Ω", 4, 0.0005),
    "tafel_slope_v": _raw("Tafel slope", "V", 4),
    "exchange_current_a": _raw("Exchange current", "A", 9),
    "c_dl_farad": _raw("Double layer capacitance", "F", 4),
    "concentration_v": _raw("Concentration loss B", "V", 4),
    "limiting_current_a": _raw("Limiting current", "A", 2),
    "internal_current_a": _raw("Internal current", "A", 4),
}
OF_CHARGE = (
    "soc_percent",
    "remaining_capacity_ah",
    "remaining_energy_wh",
    "time_to_empty_s",
    "soc_std",
    "usable_capacity_ah",
    "stability_margin",
    "delta_1",
    "delta_2",
)
"""What a fuel cell has not."""
BATTERY = ESTIMATE | ELEMENTS
FUEL_CELL = {key: entity for key, entity in ESTIMATE.items() if key not in OF_CHARGE} | STACK
PROBLEM_NAMES = {"sensor_silent": "Sensor silent", "suspicion": "Input suspected", "lock_lost": "Lock lost"}


def entities(info: Info) -> dict[str, Entity]:
    """The numbers of a pack by their keys."""
    return FUEL_CELL if info.capacity_ah is None else BATTERY


def device_id(device: str) -> str:
    """The device's name among all of Home Assistant's."""
    return f"bms_{device}"


def discovery_topic(device: str) -> str:
    """Where the discovery message goes; an empty retained payload there removes the device."""
    return f"homeassistant/device/{device_id(device)}/config"


def discovery(info: Info, root: str, sample_period_s: float) -> dict[str, Any]:
    """The discovery message.

    Args:
        info: Of the pack.
        root: Topic of the device, ``bms/<device>``.
        sample_period_s: Between two samples [s].
    """
    device = {
        "identifiers": [device_id(info.device)],
        "name": info.device,
        "model": info.cell,
        "manufacturer": "bms_estimator",
        "sw_version": info.version,
    }
    if info.board.get("serial"):
        device["serial_number"] = info.board["serial"]
    fresh_s = FRESH_PERIODS * max(1.0 / info.publish_rate_hz, sample_period_s)
    expiry_s = max(LEAST_EXPIRY_S, math.ceil(fresh_s))
    numbers = {key: _number(key, entity, root, expiry_s) for key, entity in entities(info).items()}
    problems = {key: _problem(key, name, root) for key, name in PROBLEM_NAMES.items()}
    return {
        "device": device,
        "origin": {"name": "bms_estimator", "sw_version": info.version},
        "availability": [{"topic": f"{root}/availability"}, {"topic": f"{root}/sensor/availability"}],
        "availability_mode": "all",
        "components": {
            key: component | _identity(info.device, key, component["platform"])
            for key, component in (numbers | problems).items()
        },
    }


def _identity(device: str, key: str, platform: str) -> dict[str, str]:
    entity = f"{device_id(device)}_{key}"
    return {"unique_id": entity, "default_entity_id": f"{platform}.{entity}"}


def _number(key: str, entity: Entity, root: str, expiry_s: int) -> dict[str, Any]:
    options = {
        "platform": "sensor",
        "name": entity.name,
        "state_topic": f"{root}/{VALUES}",
        "value_template": f"{{{{ value_json.{key} }}}}",
        "unit_of_measurement": entity.unit,
        "device_class": entity.device_class,
        "state_class": entity.state_class,
        "suggested_display_precision": entity.decimals,
        "entity_category": None if entity.main else "diagnostic",
        "enabled_by_default": None if entity.enabled else False,
        "expire_after": expiry_s,
    }
    return {option: value for option, value in options.items() if value is not None}


def _problem(key: str, name: str, root: str) -> dict[str, Any]:
    """On while there is a reason, which is its only attribute; it matters when the sensor is silent, too."""
    topic = f"{root}/{PROBLEMS}"
    return {
        "platform": "binary_sensor",
        "name": name,
        "state_topic": topic,
        "value_template": f"{{{{ 'ON' if value_json.{key} else 'OFF' }}}}",
        "json_attributes_topic": topic,
        "json_attributes_template": f"{{{{ {{'reason': value_json.{key}}} | tojson }}}}",
        "availability": [{"topic": f"{root}/availability"}],
        "device_class": "problem",
        "entity_category": "diagnostic",
    }
