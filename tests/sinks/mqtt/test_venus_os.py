"""Battery of a Victron GX device: names, units and signs of the README of dbus-mqtt-battery, and limits only of the user."""

import json
from typing import Any

from bms_estimator.model.payloads.snapshot import Alarm
from bms_estimator.settings.pack import PackSettings
from bms_estimator.sinks.mqtt.messages import MessageBuilder, PublishedState
from bms_estimator.sinks.mqtt.venus_os import configured_limits
from tests.sinks.snapshots import CELL_SNAPSHOT

KEYS = {
    "Dc": {"Power", "Voltage", "Current", "Temperature"},
    "Alarms": {
        *("LowVoltage", "HighVoltage", "LowSoc", "HighChargeCurrent", "HighDischargeCurrent", "HighCurrent"),
        *("CellImbalance", "HighChargeTemperature", "LowChargeTemperature", "LowCellVoltage", "LowTemperature"),
        *("HighTemperature", "FuseBlown"),
    },
    "Info": {"ChargeRequest", "MaxChargeVoltage", "MaxChargeCurrent", "MaxDischargeCurrent"},
    "System": {
        *("MinVoltageCellId", "MinCellVoltage", "MaxVoltageCellId", "MaxCellVoltage", "MinTemperatureCellId"),
        *("MinCellTemperature", "MaxTemperatureCellId", "MaxCellTemperature", "MOSTemperature"),
    },
    "Voltages": {f"Cell{number}" for number in range(1, 25)},
}
"""Keys of the groups of the message."""
NUMBERS = {"InstalledCapacity", "ConsumedAmphours", "Capacity", "Soc", "TimeToGo"}
"""Keys without a group."""
DISCHARGE: dict[str, Any] = {
    "voltage_v": 52.7,
    "current_a": 6.1,
    "power_w": 321.6,
    "temperature_c": 23.0,
    "soc": 0.63,
    "soc_known": True,
    "remaining_capacity_ah": 125.5,
    "time_to_cutoff_s": 43_967.4,
    "cells_v": [3.392, None, 3.417],
    "cell_lowest": 1,
    "cell_lowest_v": 3.392,
    "cell_highest": 3,
    "cell_highest_v": 3.417,
}
"""State of a pack that is discharged by 321.6 W."""


def alarm(name: str, *, active: bool, severity: str = "warning", watched: bool = True) -> Alarm:
    values = dict.fromkeys(("since", "value", "limit", "unit"))
    return Alarm.model_validate(
        {"name": name, "severity": severity, "active": active, "latched": False, "text": "", "watched": watched}
        | values
    )


def battery(pack: PackSettings, *alarms: Alarm, **state: Any) -> dict[str, Any] | None:
    """Return the message of a state that differs from ``DISCHARGE``; None without one."""
    assert CELL_SNAPSHOT.estimate
    estimate = CELL_SNAPSHOT.estimate.model_copy(update=DISCHARGE | state)
    info = CELL_SNAPSHOT.info.model_copy(update={"capacity_ah": 200.0})
    snapshot = CELL_SNAPSHOT._replace(estimate=estimate, info=info, alarms=alarms)
    builder = MessageBuilder("bms", "pack", venus_limits=configured_limits(pack))
    messages, _ = builder.live_messages(PublishedState(), snapshot, 0.0)
    found = [json.loads(message.payload) for message in messages if message.topic == "bms/pack/venus"]
    return found[0] if found else None


def test_names_units_and_signs_are_those_of_the_readme() -> None:
    raised = alarm("soc_low", active=True), alarm("over_temperature", active=True, severity="critical")
    limits = PackSettings(full_voltage_v=55.2, max_charge_a=80.0, max_discharge_a=120.0)
    message = battery(limits, *raised, alarm("pack_over_voltage", active=False, watched=False))
    assert message
    for key, value in message.items():
        assert (set(value) <= KEYS[key]) if isinstance(value, dict) else key in NUMBERS
    assert message["Dc"] == {"Power": -321.6, "Voltage": 52.7, "Current": -6.1, "Temperature": 23.0}
    assert {key: message[key] for key in NUMBERS} == {
        "InstalledCapacity": 200.0,
        "ConsumedAmphours": 74.5,
        "Capacity": 125.5,
        "Soc": 63.0,
        "TimeToGo": 43_967,
    }
    assert message["Info"] == {"MaxChargeVoltage": 55.2, "MaxChargeCurrent": 80.0, "MaxDischargeCurrent": 120.0}
    levels = {name: level for name, level in message["Alarms"].items() if level}
    assert levels == {
        "LowSoc": 1,
        "HighTemperature": 2,
        "HighVoltage": 1,
    }  # an alarm that cannot be watched is a warning
    assert message["Voltages"] == {"Cell1": 3.392, "Cell3": 3.417}
    assert message["System"]["MinVoltageCellId"] == "C1"
    charge = battery(limits, current_a=-6.1, power_w=-321.6)
    assert charge
    assert (charge["Dc"]["Current"], charge["Dc"]["Power"]) == (6.1, 321.6)


def test_no_limit_is_sent_that_the_user_has_not_given() -> None:
    without, partial = battery(PackSettings()), battery(PackSettings(max_charge_a=80.0))
    assert without
    assert "Info" not in without
    assert partial
    assert partial["Info"] == {"MaxChargeCurrent": 80.0}


def test_an_unknown_soc_is_replaced_by_that_of_the_device_or_not_sent() -> None:
    device = battery(PackSettings(), soc_known=False, device_soc=0.41)
    assert device
    assert device["Soc"] == 41.0
    assert not {"TimeToGo", "Capacity", "ConsumedAmphours"} & device.keys()
    assert battery(PackSettings(), soc_known=False, device_soc=None) is None
