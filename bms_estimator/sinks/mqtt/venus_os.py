"""Battery of a Victron GX device: the JSON message that dbus-mqtt-battery reads, so that Venus OS uses SOC, limits and alarms.

The keys are those of its README (github.com/mr-manuel/venus-os_dbus-mqtt-battery). Current and power are positive on charge.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from bms_estimator.model.payloads.estimate import Estimate
from bms_estimator.model.payloads.snapshot import Alarm, Info
from bms_estimator.settings.alarms import AlarmName
from bms_estimator.settings.pack import PackSettings

ALARMS: Mapping[str, tuple[AlarmName, ...]] = {
    "LowVoltage": ("pack_under_voltage",),
    "HighVoltage": ("pack_over_voltage", "cell_over_voltage"),
    "LowSoc": ("soc_low",),
    "HighChargeCurrent": ("charge_over_current",),
    "HighDischargeCurrent": ("discharge_over_current",),
    "CellImbalance": ("cell_imbalance", "weak_cell"),
    "LowChargeTemperature": ("charging_below_freezing",),
    "LowCellVoltage": ("cell_under_voltage",),
    "LowTemperature": ("under_temperature",),
    "HighTemperature": ("over_temperature",),
}
"""Alarms of the pack by alarm of Venus OS."""
OK, WARNING, ALARM = range(3)
"""Values of an alarm of Venus OS."""


def configured_limits(pack: PackSettings) -> dict[str, float]:
    """Return the limits in the settings. A limit that the user has not given is not sent."""
    limits = {
        "MaxChargeVoltage": pack.full_voltage_v,
        "MaxChargeCurrent": pack.max_charge_a,
        "MaxDischargeCurrent": pack.max_discharge_a,
    }
    return {key: limit for key, limit in limits.items() if limit is not None}


def venus_battery(
    estimate: Estimate, info: Info, alarms: Sequence[Alarm], limits: Mapping[str, float]
) -> dict[str, Any] | None:
    """Return the message; None for a pack without an SOC.

    While the SOC is not known, the SOC of the device is sent. Without it there is no message.

    Args:
        estimate: The last estimate.
        info: Identity of the pack.
        alarms: All alarms.
        limits: Limits of the charger and the inverter by key, ``configured_limits``.
    """
    is_known = estimate.soc_known and estimate.soc is not None
    soc = estimate.soc if is_known else estimate.device_soc
    if soc is None:
        return None
    capacity_ah, remaining_ah = info.capacity_ah, estimate.remaining_capacity_ah if is_known else None
    consumed_ah = None if capacity_ah is None or remaining_ah is None else max(capacity_ah - remaining_ah, 0.0)
    probes_c = [each for each in estimate.temperatures_c or (estimate.temperature_c,) if each is not None]
    cells_v = enumerate(estimate.cells_v or (), start=1)
    message = {
        "Dc": _present(
            Power=-estimate.power_w,
            Voltage=estimate.voltage_v,
            Current=-estimate.current_a,
            Temperature=estimate.temperature_c,
        ),
        "Soc": round(100.0 * soc, 1),
        "TimeToGo": round(estimate.time_to_cutoff_s) if is_known and estimate.time_to_cutoff_s is not None else None,
        "InstalledCapacity": capacity_ah,
        "Capacity": remaining_ah,
        "ConsumedAmphours": consumed_ah,
        "Info": dict(limits),
        "Alarms": {name: max(_level(alarm, names) for alarm in alarms) for name, names in ALARMS.items() if alarms},
        "System": _present(
            MinVoltageCellId=estimate.cell_lowest and f"C{estimate.cell_lowest}",
            MinCellVoltage=estimate.cell_lowest_v,
            MaxVoltageCellId=estimate.cell_highest and f"C{estimate.cell_highest}",
            MaxCellVoltage=estimate.cell_highest_v,
            MinCellTemperature=min(probes_c, default=None),
            MaxCellTemperature=max(probes_c, default=None),
        ),
        "Voltages": {f"Cell{number}": volts for number, volts in cells_v if volts is not None},
    }
    return {key: value for key, value in message.items() if value is not None and value != {}}


def _present(**values: float | str | None) -> dict[str, float | str]:
    """Return the values that are not None, numbers with three decimals."""
    return {
        key: round(value, 3) if isinstance(value, float) else value
        for key, value in values.items()
        if value is not None
    }


def _level(alarm: Alarm, names: Sequence[str]) -> int:
    """Return the value of an alarm, which is also a warning while it cannot be watched."""
    if alarm.name not in names:
        return OK
    if alarm.active:
        return ALARM if alarm.severity == "critical" else WARNING
    return OK if alarm.watched else WARNING
