"""A snapshot as lines of InfluxDB's protocol, named as a Telegraf that reads MQTT names them. Pure."""

from collections.abc import Iterator, Mapping
from datetime import datetime

from bms_estimator.model.payloads import Alarm, Estimate, Snapshot

STATE, ALARM = "bms_state", "bms_alarm"
"""Measurements; the tag ``device`` is the pack."""


def lines(before: Snapshot | None, snapshot: Snapshot) -> list[str]:
    """Return the state, if there is one, and the changed alarms as lines; times in milliseconds.

    Args:
        before: The snapshot before; None of the first.
        snapshot: The snapshot.
    """
    device = snapshot.info.device
    told = [_state(device, snapshot.estimate)] if snapshot.estimate else []
    known = {alarm.name: alarm for alarm in before.alarms} if before else {}
    changed = [alarm for alarm in snapshot.alarms if known.get(alarm.name) != alarm]
    return told + [_alarm(device, alarm, snapshot.health.publish_time) for alarm in changed]


def _state(device: str, estimate: Estimate) -> str:
    fields = dict(estimate)
    time = fields.pop("time")
    return f"{STATE},device={device} {','.join(_fields(fields))} {_ms(time)}"


def _alarm(device: str, alarm: Alarm, time: str) -> str:
    fields = {"active": alarm.active, "watched": alarm.watched, "value": alarm.value, "limit": alarm.limit}
    told = [*_fields(fields), f"text={_quoted(alarm.text)}"]
    return f"{ALARM},device={device},name={alarm.name},severity={alarm.severity} {','.join(told)} {_ms(time)}"


def _fields(values: Mapping[str, object]) -> Iterator[str]:
    """Numbers, all as floats so that no field changes its type, and truth values; a list by its places from 0."""
    for name, value in values.items():
        if isinstance(value, bool):
            yield f"{name}={'true' if value else 'false'}"
        elif isinstance(value, int | float):
            yield f"{name}={float(value)!r}"
        elif isinstance(value, list):
            yield from _fields({f"{name}_{place}": item for place, item in enumerate(value)})


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", " ")
    return f'"{escaped}"'


def _ms(iso: str) -> int:
    return round(datetime.fromisoformat(iso).timestamp() * 1000.0)
