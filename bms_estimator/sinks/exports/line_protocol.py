"""Conversion of snapshots to InfluxDB's line protocol, with the names that Telegraf gives MQTT payloads. No I/O."""

from collections.abc import Iterator, Mapping
from datetime import datetime

from bms_estimator.model.payloads.alarm import Alarm
from bms_estimator.model.payloads.estimate import Estimate
from bms_estimator.model.payloads.snapshot import Snapshot

STATE = "bms_state"
"""Name of the measurement of states. The tag ``device`` is the pack."""
ALARM = "bms_alarm"
"""Name of the measurement of alarm changes. The tag ``device`` is the pack."""


def lines(before: Snapshot | None, snapshot: Snapshot) -> list[str]:
    """Return lines of the state, if there is one, and of changed alarms, with times in milliseconds.

    Args:
        before: Previous snapshot; None for the first one.
        snapshot: Snapshot to convert.
    """
    device = snapshot.info.device
    state = [_state(device, snapshot.estimate)] if snapshot.estimate else []
    previous = {alarm.name: alarm for alarm in before.alarms} if before else {}
    changed = [alarm for alarm in snapshot.alarms if previous.get(alarm.name) != alarm]
    return state + [_alarm(device, alarm, snapshot.health.publish_time) for alarm in changed]


def _state(device: str, estimate: Estimate) -> str:
    fields = dict(estimate)
    time = fields.pop("time")
    return f"{STATE},device={device} {','.join(_fields(fields))} {_epoch_ms(time)}"


def _alarm(device: str, alarm: Alarm, time: str) -> str:
    fields = {"active": alarm.active, "watched": alarm.watched, "value": alarm.value, "limit": alarm.limit}
    items = [*_fields(fields), f"text={_quoted(alarm.text)}"]
    return f"{ALARM},device={device},name={alarm.name},severity={alarm.severity} {','.join(items)} {_epoch_ms(time)}"


def _fields(values: Mapping[str, object]) -> Iterator[str]:
    """Yield Booleans and numbers as fields, and list items as fields numbered from 0.

    All numbers become floats, because a field must not change its type.
    """
    for name, value in values.items():
        if isinstance(value, bool):
            yield f"{name}={'true' if value else 'false'}"
        elif isinstance(value, int | float):
            yield f"{name}={float(value)!r}"
        elif isinstance(value, list):
            yield from _fields({f"{name}_{index}": item for index, item in enumerate(value)})


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", " ")
    return f'"{escaped}"'


def _epoch_ms(iso: str) -> int:
    return round(datetime.fromisoformat(iso).timestamp() * 1000.0)
