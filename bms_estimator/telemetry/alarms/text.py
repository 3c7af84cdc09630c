"""Text of an alarm in its payload."""

from collections.abc import Sequence

from bms_estimator.settings.alarm_limits import AlarmDefinition

LATCHED = "the cause is gone; acknowledge it to end it: "
"""Prefix of the text of a latched alarm."""


def alarm_text(alarm: AlarmDefinition, value: float | None, reasons: Sequence[str], *, cause_cleared: bool) -> str:
    """Return one or two sentences: the fault and its remedy.

    Args:
        alarm: The alarm.
        value: Value when the alarm was raised, in the unit of the alarm; None without a number.
        reasons: Other causes, one sentence each.
        cause_cleared: True if the cause is gone but the alarm is latched.
    """
    unit = f" {alarm.kind.unit}" if alarm.kind.unit else ""
    numbers = "" if value is None else f": {value:.4g}{unit}, limit {alarm.limit:.4g}{unit}"
    text = f"{alarm.kind.fault}{numbers}; {alarm.kind.remedy}"
    return (LATCHED if cause_cleared else "") + "; ".join((text, *reasons))
