"""Home Assistant's device discovery: one retained message that describes all entities of one pack."""

import math
from typing import Any

from bms_estimator.model.estimate import Info
from bms_estimator.sinks import FRESH_PERIODS

BIRTH_TOPIC = "homeassistant/status"
"""Home Assistant says ``online`` here when it has started."""
LEAST_EXPIRY_S = 3
"""Home Assistant calls no value unavailable that is younger than this: parameters come but once a second [s]."""

_ESTIMATE = {
    # field of topic state: (name, unit, device class, decimals)
    "voltage_v": ("Voltage", "V", "voltage", 3),
    "current_a": ("Current (discharge positive)", "A", "current", 3),
    "power_w": ("Power (discharge positive)", "W", "power", 2),
    "temperature_c": ("Temperature", "°C", "temperature", 1),
    "soc_percent": ("State of charge", "%", "battery", 1),
    "remaining_capacity_ah": ("Remaining capacity", "Ah", None, 3),
    "remaining_energy_wh": ("Remaining energy", "Wh", "energy_storage", 2),
    "time_to_empty_s": ("Time to empty", "s", "duration", 0),
    "usable_capacity_ah": ("Usable capacity", "Ah", None, 3),
    "soc_std": ("State of charge, standard deviation", None, None, 4),
    "voltage_estimate_v": ("Estimated voltage", "V", "voltage", 3),
    "innovation_v": ("Innovation", "V", "voltage", 4),
    "stability_margin": ("Stability margin", None, None, 4),
    "delta_1": ("delta 1", None, None, 4),
    "delta_2": ("delta 2", None, None, 4),
    "adaptive_gain_k": ("Adaptive gain k", "V²s", None, 6),
    "nussbaum_gain": ("Nussbaum gain", None, None, 4),
    "sample_rate_hz": ("Sample rate", "Hz", "frequency", 1),
}
_ELEMENTS = {
    "r_s_ohm": ("R_s", "Ω", 5),
    "r_ts_ohm": ("R_ts", "Ω", 5),
    "r_tl_ohm": ("R_tl", "Ω", 5),
    "c_ts_farad": ("C_ts", "F", 1),
    "c_tl_farad": ("C_tl", "F", 1),
}
_FAULTS = {"frames_lost": "Frames lost", "crc_errors": "CRC errors"}
_MAIN = {"voltage_v", "current_a", "power_w", "temperature_c", "soc_percent", "time_to_empty_s"}
_MAIN |= {"remaining_capacity_ah", "remaining_energy_wh"}


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
    return {
        "device": device,
        "origin": {"name": "bms_estimator", "sw_version": info.version},
        "availability": [{"topic": f"{root}/availability"}, {"topic": f"{root}/sensor/availability"}],
        "availability_mode": "all",
        "components": _components(info, root, sample_period_s),
    }


def _components(info: Info, root: str, sample_period_s: float) -> dict[str, Any]:
    fresh_s = FRESH_PERIODS * max(1.0 / info.publish_rate_hz, sample_period_s)
    stale_s = max(LEAST_EXPIRY_S, math.ceil(fresh_s))
    components: dict[str, Any] = {}

    def add(key: str, platform: str, name: str, **options: Any) -> None:
        entity = f"{device_id(info.device)}_{key}"
        components[key] = {
            "platform": platform,
            "unique_id": entity,
            "default_entity_id": f"{platform}.{entity}",
            "name": name,
            **{option: value for option, value in options.items() if value is not None},
        }

    for key, (name, unit, device_class, decimals) in _ESTIMATE.items():
        add(
            key,
            "sensor",
            name,
            state_topic=f"{root}/state",
            value_template=f"{{{{ value_json.{key} }}}}",
            unit_of_measurement=unit,
            device_class=device_class,
            state_class="measurement",
            suggested_display_precision=decimals,
            entity_category=None if key in _MAIN else "diagnostic",
            expire_after=stale_s,
        )
    for key, (name, unit, decimals) in _ELEMENTS.items():
        add(
            key,
            "sensor",
            name,
            state_topic=f"{root}/parameters",
            value_template=f"{{{{ value_json.elements.{key}.value }}}}",
            unit_of_measurement=unit,
            state_class="measurement",
            suggested_display_precision=decimals,
            entity_category="diagnostic",
            expire_after=stale_s,
        )
    for key, name in _FAULTS.items():
        add(
            key,
            "sensor",
            name,
            state_topic=f"{root}/state",
            value_template=f"{{{{ value_json.{key} }}}}",
            state_class="total_increasing",
            entity_category="diagnostic",
            expire_after=stale_s,
        )
    add(
        "lock_lost",
        "binary_sensor",
        "Lock lost",
        state_topic=f"{root}/state",
        value_template="{{ 'OFF' if value_json.lock else 'ON' }}",
        device_class="problem",
        entity_category="diagnostic",
        expire_after=stale_s,
    )
    add(
        "sensor_silent",
        "binary_sensor",
        "Sensor silent",
        state_topic=f"{root}/health",
        value_template="{{ 'OFF' if value_json.sensor_online else 'ON' }}",
        json_attributes_topic=f"{root}/health",
        availability=[{"topic": f"{root}/availability"}],
        device_class="problem",
        entity_category="diagnostic",
    )
    add(
        "suspicion",
        "binary_sensor",
        "Input suspected",
        state_topic=f"{root}/health",
        value_template="{{ 'ON' if value_json.suspects else 'OFF' }}",
        json_attributes_topic=f"{root}/health",
        availability=[{"topic": f"{root}/availability"}],
        device_class="problem",
        entity_category="diagnostic",
    )
    return components
