"""Texts of alarms."""

from collections.abc import Sequence

from bms_estimator.settings.alarm_limits import AlarmDefinition
from bms_estimator.settings.alarms import AlarmName

LATCHED = "the cause is gone; acknowledge it to end it: "

_WHAT: dict[AlarmName, tuple[str, str]] = {
    "pack_over_voltage": ("the pack's voltage is too high", "stop charging"),
    "pack_under_voltage": ("the pack's voltage is too low", "take the load off, charge"),
    "cell_over_voltage": ("a cell's voltage is too high", "stop charging, let the cells be balanced"),
    "cell_under_voltage": ("a cell's voltage is too low", "take the load off, charge"),
    "discharge_over_current": ("the load takes too much current", "reduce it"),
    "charge_over_current": ("too much current goes into the pack", "reduce the charger's"),
    "over_temperature": ("the pack is too hot", "stop the current, let it cool"),
    "under_temperature": ("the pack is too cold", "warm it before it is used"),
    "charging_below_freezing": ("the pack is charged while it freezes", "stop charging: it plates lithium"),
    "soc_low": ("little charge is left (SOC less its standard deviation)", "charge"),
    "stability_margin_low": ("the SOC is close to where the model ends", "charge"),
    "cell_imbalance": ("the cells' voltages differ", "let them be balanced, look for a weak one"),
    "sensor_fault": (
        "samples are lost, cannot be used or come from two publishers",
        "check sensors and wiring; topic health counts what is wrong",
    ),
    "model_mismatch": ("measured and estimated voltage disagree", "check that the cell file belongs to this pack"),
    "link_lost": ("no samples come", "check board, cable and power"),
    "hook_failed": ("an alarm hook could not do its work", "check its program; do by hand what it is for"),
}


def alarm_text(watched: AlarmDefinition, value: float | None, reasons: Sequence[str], *, gone: bool) -> str:
    """Return a sentence or two: the fault, and its remedy.

    Args:
        watched: The alarm.
        value: Measured value when it was raised; None: there is no number.
        reasons: Other known causes.
        gone: The cause is gone, but the alarm is latched.
    """
    what, to_do = _WHAT[watched.name]
    unit = f" {watched.unit}" if watched.unit else ""
    numbers = "" if value is None else f": {value:.4g}{unit}, limit {watched.limit:.4g}{unit}"
    said = f"{what}{numbers}; {to_do}"
    return (LATCHED if gone else "") + "; ".join((said, *reasons))
