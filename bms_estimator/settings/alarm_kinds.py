"""Table of all alarms: fault, remedy, required quantities, and unit of the limit."""

from collections.abc import Mapping
from typing import Literal, NamedTuple

from bms_estimator.settings.alarms import AlarmName

Quantity = Literal["voltage", "current", "temperature", "cells"]
"""Measured quantity of a sample."""


class AlarmKind(NamedTuple):
    """Properties of an alarm that are equal for all packs."""

    fault: str
    """Description of the fault."""
    remedy: str
    """Advice to the user."""
    needs: tuple[Quantity, ...] = ()
    """Quantities without which the alarm cannot be evaluated; empty for alarms about the samples themselves."""
    unit: str | None = None
    """Unit of value and limit; None for a number without unit."""
    is_fraction: bool = False
    """True if value and limit are 0..1, which texts show in %."""
    is_upper_limit: bool = True
    """True if the alarm is raised at or above its limit, False if at or below."""
    device_class: str = "problem"
    """Device class in Home Assistant."""


ALARM_KINDS: Mapping[AlarmName, AlarmKind] = {
    "pack_over_voltage": AlarmKind("the pack's voltage is too high", "stop charging", ("voltage",), "V"),
    "pack_under_voltage": AlarmKind(
        "the pack's voltage is too low", "remove the load, and charge", ("voltage",), "V", is_upper_limit=False
    ),
    "cell_over_voltage": AlarmKind(
        "a cell's voltage is too high", "stop charging, and let the cells balance", ("cells",), "V"
    ),
    "cell_under_voltage": AlarmKind(
        "a cell's voltage is too low", "remove the load, and charge", ("cells",), "V", is_upper_limit=False
    ),
    "discharge_over_current": AlarmKind("the load draws too much current", "reduce the load", ("current",), "A"),
    "charge_over_current": AlarmKind(
        "the charge current is too high", "reduce the current of the charger", ("current",), "A"
    ),
    "over_temperature": AlarmKind(
        "the pack is too hot", "stop the current, and let the pack cool", ("temperature",), "°C", device_class="heat"
    ),
    "under_temperature": AlarmKind(
        "the pack is too cold",
        "warm the pack before use",
        ("temperature",),
        "°C",
        is_upper_limit=False,
        device_class="cold",
    ),
    "charging_below_freezing": AlarmKind(
        "the pack is charged below freezing",
        "stop charging, because it plates lithium",
        ("current", "temperature"),
        "°C",
        is_upper_limit=False,
        device_class="cold",
    ),
    "soc_low": AlarmKind(
        "little charge is left (SOC minus its standard deviation)",
        "charge",
        ("voltage", "current"),
        is_fraction=True,
        is_upper_limit=False,
        device_class="battery",
    ),
    "collapse_risk": AlarmKind(
        "the voltage may reach the cut-off within 5 min (probability)",
        "reduce the load, and charge",
        ("voltage", "current"),
        is_fraction=True,
    ),
    "stability_margin_low": AlarmKind(
        "the SOC is close to the value below which the thesis's model is not valid",
        "charge; not this value but the cut-off voltage limits the discharge",
        ("voltage", "current"),
        is_upper_limit=False,
    ),
    "cell_imbalance": AlarmKind(
        "the cells' voltages differ", "let the cells balance, and look for a weak cell", ("cells",), "V"
    ),
    "weak_cell": AlarmKind(
        "one cell of the bank is weaker than the others, and is empty first",
        "measure each cell, because the bank's voltage does not show which one it is; until then charge earlier",
        ("voltage", "current"),
    ),
    "cell_short": AlarmKind(
        "a cell discharges itself, as with an internal short",
        "disconnect the pack, move it away from anything that burns, and replace the cell",
        ("current", "cells"),
        "A",
    ),
    "cell_sensor_fault": AlarmKind(
        "the reading of a cell's voltage is wrong",
        "check the contacts and sense wires of the cell; the cell itself may be intact",
        ("current", "cells"),
        "V",
    ),
    "sensor_fault": AlarmKind(
        "samples are lost, unusable or from two publishers",
        "check sensors and wiring; the counters in topic health name the fault",
        is_fraction=True,
    ),
    "model_mismatch": AlarmKind(
        "measured and estimated voltage disagree",
        "check that the cell file belongs to this pack",
        ("voltage", "current"),
        "V",
    ),
    "link_lost": AlarmKind(
        "no samples arrive", "check the device, its power, its connection and, for MQTT, the broker", unit="s"
    ),
    "hook_failed": AlarmKind(
        "the last run of an alarm hook failed", "check the hook, and do by hand what it should have done"
    ),
    "alarm_state_lost": AlarmKind(
        "raised alarms of an earlier run may be missing, so that all hooks count an alarm",
        "check the pack, and that each sensor measures, then acknowledge this alarm (request acknowledge_alarm, or SIGUSR1 to the service)",
    ),
}
"""All alarms by name."""
