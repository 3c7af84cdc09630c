"""Messages about an alarm: its payload with a text, and its changes."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

from bms_estimator.model.clock import iso_utc
from bms_estimator.model.payloads.snapshot import Alarm
from bms_estimator.settings.alarm_limits import AlarmDefinition
from bms_estimator.settings.alarms import AlarmName


class RaisedAlarm(NamedTuple):
    """Time and value at which an alarm was raised."""

    since_s: float
    """Time on the wall clock at which the alarm was raised [s since 1970]."""
    value: float | None
    """Value in the unit of the alarm; None if the alarm has no number."""


LATCHED = "the cause is gone; acknowledge it (request acknowledge_alarm if mqtt.commands lists it, or SIGUSR1 to the service) to end it: "
"""Prefix of the text of a latched alarm."""
CAUSE_FIRST: tuple[AlarmName, ...] = ("sensor_fault", "link_lost")
"""Alarms whose cause stands before their general text, which fits many causes and would hide it."""


def alarm_text(alarm: AlarmDefinition, value: float | None, reasons: Sequence[str], *, cause_cleared: bool) -> str:
    """Return one or two sentences: the fault and its remedy.

    Args:
        alarm: The alarm.
        value: Value when the alarm was raised, in the unit of the alarm; None without a number.
        reasons: Other causes, one sentence each.
        cause_cleared: True if the cause is gone but the alarm is latched.
    """
    factor, unit = (100.0, " %") if alarm.kind.is_fraction else (1.0, f" {alarm.kind.unit}" if alarm.kind.unit else "")
    numbers = "" if value is None else f": {factor * value:.4g}{unit}, limit {factor * alarm.limit:.4g}{unit}"
    text = f"{alarm.kind.fault}{numbers}; {alarm.kind.remedy}"
    texts = (*reasons, text) if alarm.name in CAUSE_FIRST else (text, *reasons)
    return (LATCHED if cause_cleared else "") + "; ".join(texts)


class Change(NamedTuple):
    """Change of an alarm: raised, ended, no longer watched, or watched again."""

    at_s: float
    """Time on the samples' clock [s]."""
    alarm: Alarm
    field: Literal["active", "watched"] = "active"
    """Field of ``alarm`` that has changed."""


class AlarmMessage(NamedTuple):
    """Changing content of an alarm's payload."""

    raised: RaisedAlarm | None
    """Time and value of an active alarm; None if inactive."""
    cause_cleared: bool
    """True if the cause is gone but the alarm is latched."""
    reasons: tuple[str, ...]
    """Causes, one sentence each."""
    unwatched_reason: str | None
    """Reason why the alarm cannot be watched; None while it is watched."""
    unknown_reason: str | None
    """Reason why the value of the alarm is not known; None while it is known."""


def alarm_payload(definition: AlarmDefinition, message: AlarmMessage) -> Alarm:
    """Return the payload of an alarm."""
    raised, value = message.raised, message.raised.value if message.raised else None
    text = alarm_text(definition, value, message.reasons, cause_cleared=message.cause_cleared) if raised else ""
    return Alarm(
        name=definition.name,
        severity=definition.severity,
        active=raised is not None,
        latched=message.cause_cleared,
        since=iso_utc(raised.since_s) if raised else None,
        value=value,
        limit=definition.limit,
        unit=definition.kind.unit,
        text=text,
        watched=message.unwatched_reason is None,
        unwatched_reason=message.unwatched_reason,
        unknown_reason=message.unknown_reason,
    )
