"""Device discovery of Home Assistant: one retained message that describes all entities of a pack.

Home Assistant's recorder stores a row for each change of each entity. The values of entities therefore have
a separate topic, on which they are rounded and published rarely (``entity_values``). Entities for research are disabled by default.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple, get_args

from bms_estimator.model.errors import UserError
from bms_estimator.model.payloads.estimate import Estimate
from bms_estimator.model.payloads.health import FRESH_PERIODS
from bms_estimator.model.payloads.snapshot import Info
from bms_estimator.model.quantity import Entity, field_entities, raw_entity
from bms_estimator.settings.alarm_kinds import ALARM_KINDS
from bms_estimator.settings.alarms import ALARMS
from bms_estimator.settings.connections import Command, HomeAssistantSettings
from bms_estimator.settings.pack import MAX_RATE_HZ, MIN_RATE_HZ

ESTIMATE = field_entities(Estimate, "all")
"""Entities of every pack."""
CHARGE_STATE = field_entities(Estimate, "batteries") | {
    "soc_std_percent": Entity(
        "State of charge, standard deviation", "%", 1, 0.2, icon="plus-minus-variant", immediate_step=2.0
    ),
    "time_to_cutoff_h": Entity("Time to cut-off", "h", 2, 0.05, "duration", is_primary=True, icon="timer-sand"),
    "time_to_cutoff_p05_h": raw_entity("Time to cut-off, 5 % quantile", "h", 2, "duration"),
    "time_to_cutoff_p95_h": raw_entity("Time to cut-off, 95 % quantile", "h", 2, "duration"),
    "cutoff_within_15min_percent": Entity(
        "Probability of cut-off within 15 min", "%", 0, 5.0, is_primary=True, icon="power-plug-off"
    ),
    "time_to_full_h": Entity("Time to full", "h", 2, 0.05, "duration", is_primary=True, icon="battery-clock"),
    "soh_percent": Entity("State of health, capacity of new", "%", 1, 0.2, icon="battery-heart-variant"),
    "soh_std_percent": raw_entity("State of health, standard deviation", "%", 1),
}
"""Entities of a battery that a fuel cell does not have.

``field_entities`` cannot make the entities listed here, because their units differ from those of the payloads.
"""
CELL_VOLTAGES = field_entities(Estimate, "with cell voltages")
"""Entities of packs with measured cell voltages."""
CELL = "cell_v"
"""Key in ``[home_assistant.names]`` that renames the voltages of all single cells; each name ends in the number."""
ELEMENTS = {
    "r_s_mohm": Entity("Internal resistance R_s", "mΩ", decimals=1, step=0.5, icon="resistor"),
    # ``raw_entity``: internal value, disabled by default; its minimum change is one unit of the last decimal
    "r_ts_ohm": raw_entity("R_ts", "Ω", 4),
    "r_tl_ohm": raw_entity("R_tl", "Ω", 4),
    "c_ts_farad": raw_entity("C_ts", "F", 0),
    "c_tl_farad": raw_entity("C_tl", "F", 0),
}
"""Entities of a battery's learned parameters, by element of ``ParameterReport``."""
STACK = {
    "r_ohm": Entity("Resistance", "Ω", decimals=4, step=0.0005),
    "tafel_slope_v": raw_entity("Tafel slope", "V", 4),
    "exchange_current_a": raw_entity("Exchange current", "A", 9),
    "c_dl_farad": raw_entity("Double layer capacitance", "F", 4),
    "concentration_v": raw_entity("Concentration loss B", "V", 4),
    "limiting_current_a": raw_entity("Limiting current", "A", 2),
    "internal_current_a": raw_entity("Internal current", "A", 4),
}
"""Entities of a fuel cell's learned parameters, by element of ``ParameterReport``."""
BATTERY = ESTIMATE | CHARGE_STATE | ELEMENTS
FUEL_CELL = ESTIMATE | STACK


def cell_key(number: int) -> str:
    """Return the key of a single cell's voltage; numbers start from 1."""
    return f"cell_{number}_v"


def entities(info: Info, cells: int) -> dict[str, Entity]:
    """Return the numeric entities of a pack with ``cells`` measured cells, by key."""
    without_cells = FUEL_CELL if info.capacity_ah is None else BATTERY
    if not cells:
        return without_cells
    return (
        without_cells
        | CELL_VOLTAGES
        | {cell_key(n): raw_entity(f"Cell {n}", "V", 3, "voltage") for n in range(1, cells + 1)}
    )


VALUES = "home_assistant"
"""Topic of the values, below the device's topic."""
MIN_EXPIRY_S = 30
"""Minimum of ``expire_after``, the age at which Home Assistant shows a value as unavailable [s]."""
_ALARM_CLASSES: Mapping[str, str] = {name: kind.device_class for name, kind in ALARM_KINDS.items()}
_ALARM_LABELS = {"soc_low": "State of charge low", "collapse_risk": "Cut-off within 5 min likely"}
"""Names of alarms whose key is not an owner's word."""
_ALARM_AVAILABILITY = "{{ 'online' if value_json.watched or value_json.active else 'offline' }}"
"""Template of an alarm's availability. A raised alarm stays available even if its quantity is lost later."""
FORMER_SENSORS = ("r_s_ohm",)
"""Keys of sensors of former versions, which Home Assistant removes."""
_SOC_HINT = "{{ {'hint': '' if value_json.soc_percent is number else 'not known yet: charge the pack to full once, or (not LFP) let it rest for ten minutes'} | tojson }}"
"""Template of the attribute ``hint``, which names the remedy while the state of charge is not known."""
NAMEABLE = {*BATTERY, *FUEL_CELL, *CELL_VOLTAGES, CELL, *ALARMS, *get_args(Command)}
"""Entities that ``[home_assistant.names]`` may rename."""


class DiscoveryInputs(NamedTuple):
    """Data that determine the entities of a pack."""

    info: Info
    cells: int = 0
    """Number of measured cells."""
    alarms: tuple[str, ...] = ()
    commands: tuple[str, ...] = ()
    """Allowed commands."""
    unwatched: tuple[str, ...] = ()
    """Alarms that are not monitored; an earlier configuration may have monitored them."""


def check_names(settings: HomeAssistantSettings) -> None:
    """Check the entity names of the settings.

    Raises:
        UserError: An entity is unknown.
    """
    unknown = sorted(set(settings.names) - NAMEABLE)
    if unknown:
        raise UserError(
            f"home_assistant.names.{unknown[0]}: there is no such entity; there are {', '.join(sorted(NAMEABLE))}"
        )


def device_id(device: str) -> str:
    """Return the device's identifier in Home Assistant."""
    return f"bms_{device}"


def discovery_topic(settings: HomeAssistantSettings, device: str) -> str:
    """Return the topic of the discovery message; an empty retained payload there removes the device."""
    return f"{settings.discovery_prefix}/device/{device_id(device)}/config"


def discovery(
    settings: HomeAssistantSettings, inputs: DiscoveryInputs, root: str, sample_period_s: float
) -> dict[str, Any]:
    """Return the discovery message.

    Args:
        settings: Settings of Home Assistant.
        inputs: Data that determine the entities.
        root: Topic of the device, ``bms/<device>``.
        sample_period_s: Sample period [s].
    """
    info = inputs.info
    device = {
        "identifiers": [device_id(info.device)],
        "name": settings.name or info.device,
        "model": info.cell,
        "manufacturer": "bms_estimator",
        "sw_version": info.version,
    }
    if info.board.get("serial"):
        device["serial_number"] = info.board["serial"]
    expiry_s = max(MIN_EXPIRY_S, math.ceil(FRESH_PERIODS * max(1.0 / info.publish_rate_hz, sample_period_s)))
    sensors = entities(info, inputs.cells).items()
    positive = _constant({"positive": settings.current_sign.removesuffix("_positive")})
    templates = {"soc_percent": _SOC_HINT} | {key: positive for key, entity in sensors if entity.signed}
    for direction, limit_a in (("discharge", info.max_discharge_a), ("charge", info.max_charge_a)):
        keys = [f"available_{direction}_power_{time}_w" for time in ("10s", "60s") if limit_a is None]
        templates |= dict.fromkeys(
            keys, _constant({"hint": f"current limit assumed: max_{direction}_a is not in [pack]"})
        )
    components = {
        **{
            key: _sensor(key, entity, root, expiry_s) | _attributes(root, templates.get(key)) for key, entity in sensors
        },
        **{f"alarm_{name}": _alarm(name, root) for name in inputs.alarms},
        **{name: control for name, control in _controls(root).items() if name in inputs.commands},
    }
    numbers = range(1, inputs.cells + 1) if CELL in settings.names else ()
    names = settings.names | {cell_key(number): f"{settings.names[CELL]} {number}" for number in numbers}
    return {
        "device": device,
        "origin": {"name": "bms_estimator", "sw_version": info.version},
        "availability": [{"topic": f"{root}/availability"}, {"topic": f"{root}/sensor/availability"}],
        "availability_mode": "all",
        "components": {
            key: component | _identity(info.device, key, component["platform"]) | _configured_name(names, key)
            for key, component in components.items()
        }
        | _removed_components(inputs),
    }


def _removed_components(inputs: DiscoveryInputs) -> dict[str, dict[str, str]]:
    """Return components that an earlier configuration may have had, in the form that makes Home Assistant remove them.

    Home Assistant removes a component if the message contains only its platform.
    """
    platforms = {f"alarm_{name}": "binary_sensor" for name in inputs.unwatched} | dict.fromkeys(
        FORMER_SENSORS, "sensor"
    )
    platforms |= {name: control["platform"] for name, control in _controls("").items() if name not in inputs.commands}
    return {key: {"platform": platform} for key, platform in platforms.items()}


def _configured_name(names: Mapping[str, str], key: str) -> dict[str, str]:
    name = names.get(key.removeprefix("alarm_"))
    return {"name": name} if name else {}


def _identity(device: str, key: str, platform: str) -> dict[str, str]:
    """Return an entity id that does not depend on the name, so that a dashboard works in any language.

    Home Assistant before 2025.10 reads ``object_id``; later versions ignore it beside ``default_entity_id``.
    """
    entity = f"{device_id(device)}_{key}"
    return {"unique_id": entity, "default_entity_id": f"{platform}.{entity}", "object_id": entity}


def _sensor(key: str, entity: Entity, root: str, expiry_s: int) -> dict[str, Any]:
    topic = f"{root}/{VALUES}"
    options = {
        "platform": "sensor",
        "name": entity.name,
        "state_topic": topic,
        "value_template": f"{{{{ value_json.{key} }}}}",
        "unit_of_measurement": entity.unit,
        "device_class": entity.device_class,
        "icon": entity.icon and f"mdi:{entity.icon}",
        "state_class": entity.state_class,
        "suggested_display_precision": entity.decimals,
        "entity_category": None if entity.is_primary else "diagnostic",
        "enabled_by_default": None if entity.enabled else False,
        "expire_after": expiry_s,
    }
    return {option: value for option, value in options.items() if value is not None}


def _constant(attributes: dict[str, str]) -> str:
    """Return the template of constant attributes."""
    return f"{{{{ {attributes} | tojson }}}}"


def _attributes(root: str, template: str | None) -> dict[str, str]:
    """Return the options of attributes by a template; None: an entity without attributes."""
    return {"json_attributes_topic": f"{root}/{VALUES}", "json_attributes_template": template} if template else {}


def _alarm(name: str, root: str) -> dict[str, Any]:
    """Return the sensor of an alarm: on while raised; otherwise off, unknown while its value is, or unavailable if not monitored."""
    topic = f"{root}/alarm/{name}"
    return {
        "platform": "binary_sensor",
        "name": _ALARM_LABELS.get(name, name.replace("_", " ").capitalize()),
        "state_topic": topic,
        "value_template": "{{ 'ON' if value_json.active else 'None' if value_json.unknown_reason else 'OFF' }}",
        "json_attributes_topic": topic,
        "json_attributes_template": "{{ {'reason': value_json.text or value_json.unknown_reason or '', 'severity': value_json.severity} | tojson }}",
        "availability": [{"topic": f"{root}/availability"}, {"topic": topic, "value_template": _ALARM_AVAILABILITY}],
        "availability_mode": "all",
        "device_class": _ALARM_CLASSES[name],
    } | ({"enabled_by_default": False} if name == "stability_margin_low" else {})


def _controls(root: str) -> dict[str, dict[str, Any]]:
    """Return the controls by command.

    The control of the SOC shows the last set value, because the live SOC would add a row to the recorder with each change. The button that
    discards what was learned is disabled, because a press cannot be undone.
    """
    sensorless = dict[str, Any](availability=[{"topic": f"{root}/availability"}])  # available without a sensor, too
    config, button = dict[str, Any](entity_category="config"), dict[str, Any](platform="button", payload_press="{}")
    controls = {
        "set_soc": config
        | {
            "platform": "number",
            "name": "Set state of charge",
            "command_template": '{"soc": {{ value / 100 }}}',
            "min": 0,
            "max": 100,
            "step": 0.1,
            "mode": "box",
            "unit_of_measurement": "%",
        },
        "current_zero": config | button | {"name": "Take present current as zero"},
        "acknowledge_alarm": sensorless | button | {"name": "Acknowledge alarms"},
        "publish_rate": sensorless
        | config
        | {
            "platform": "number",
            "name": "Publish rate",
            "state_topic": f"{root}/info",
            "value_template": "{{ value_json.publish_rate_hz }}",
            "command_template": '{"rate_hz": {{ value }}}',
            "min": MIN_RATE_HZ,
            "max": MAX_RATE_HZ,
            "step": 0.1,
            "mode": "box",
            "unit_of_measurement": "Hz",
        },
        "forget_pack": sensorless | config | button | {"name": "Forget pack", "enabled_by_default": False},
    }
    return {name: {"command_topic": f"{root}/request/{name}"} | control for name, control in controls.items()}
