"""Topic ``event``: what happened to a pack, once each, found by comparing one snapshot with the one before. Pure."""

from collections.abc import Iterator
from typing import Literal, NamedTuple

from pydantic import Field

from bms_estimator.model.input_faults import InputFault
from bms_estimator.model.payloads import Health, Payload, Snapshot

MIN_UNSEEN_S = 1.0
"""Shorter gaps are counted in ``health`` alone [s]."""
NOT_SAVED = ("cannot be saved", "not saved")
"""Beginnings of ``health.checkpoint`` when the disk does not accept it."""

Name = Literal[
    "start",
    "unseen",
    "sensor_offline",
    "sensor_online",
    "suspicion",
    "suspicion_cleared",
    "checkpoint_fails",
    "checkpoint_saved",
    "alarm_raised",
    "alarm_cleared",
    "alarm_unwatched",
    "alarm_watched",
]


class Event(Payload):
    """Topic ``event``, not retained: something that happened."""

    time: str = Field(description="when it was seen, ISO 8601, UTC")
    name: Name = Field(description="what it is")
    text: str = Field(description="for people: the reason, what to do")


class _Found(NamedTuple):
    name: Name
    text: str


def events(before: Snapshot | None, snapshot: Snapshot) -> list[Event]:
    """Yield the events between two snapshots.

    Args:
        before: The snapshot before; None: the service has just started.
        snapshot: The snapshot.
    """
    health = snapshot.health
    if before is None:
        started = _Found("start", f"checkpoint: {health.checkpoint}")
        found = [started, *_unseen(health.unseen_s or 0.0), *_sensor(None, health)]
        found += [*_suspicions([], health.suspects), *_checkpoint("", health)]
    elif before.health is health:
        found = []
    else:
        was = before.health
        unseen = _unseen(health.total.unseen_s - was.total.unseen_s)
        found = [*unseen, *_sensor(was, health), *_suspicions(was.suspects, health.suspects)]
        found += _checkpoint(was.checkpoint, health)
    of_health = [Event(time=health.publish_time, name=name, text=text) for name, text in found]
    seen = snapshot.estimate.publish_time if snapshot.estimate else health.publish_time
    return of_health + [Event(time=seen, name=name, text=text) for name, text in _alarms(before, snapshot)]


def _alarms(before: Snapshot | None, snapshot: Snapshot) -> Iterator[_Found]:
    """Yield raised and ended alarms. One that ended and was raised again in between has another ``since``.

    An alarm raised before the start was reported by the run before.
    """
    was = {alarm.name: alarm.since for alarm in before.alarms} if before else {}
    for alarm in snapshot.alarms:
        since = was.get(alarm.name)
        if since is not None and since != alarm.since:
            yield _Found("alarm_cleared", alarm.name)
        if alarm.since is not None and since != alarm.since and alarm.since >= snapshot.info.started:
            yield _Found("alarm_raised", f"{alarm.name}: {alarm.text}")
    yield from _watched(before, snapshot)


def _watched(before: Snapshot | None, snapshot: Snapshot) -> Iterator[_Found]:
    """Alarms that can no longer be watched, and those that can again."""
    was = {alarm.name: alarm.watched for alarm in before.alarms} if before else {}
    for alarm in snapshot.alarms:
        if was.get(alarm.name, True) and not alarm.watched:
            yield _Found("alarm_unwatched", f"{alarm.name}: {alarm.unwatched_reason}")
        elif alarm.watched and not was.get(alarm.name, True):
            yield _Found("alarm_watched", alarm.name)


def _unseen(unseen_s: float) -> Iterator[_Found]:
    if unseen_s >= MIN_UNSEEN_S:
        yield _Found("unseen", f"nobody measured for {unseen_s:.1f} s")


def _sensor(was: Health | None, health: Health) -> Iterator[_Found]:
    if was is not None and was.sensor_online == health.sensor_online:
        return
    if health.sensor_online:
        yield _Found("sensor_online", "samples come")
    elif was is not None:  # none at start
        yield _Found("sensor_offline", health.sensor_message or "")


def _suspicions(was: list[str], now: list[str]) -> Iterator[_Found]:
    """Yield suspicions that began and ended; numbers in their sentences may change meanwhile."""
    before, after = ({_kind(sentence): sentence for sentence in sentences} for sentences in (was, now))
    for kind, sentence in after.items():
        if kind not in before:
            yield _Found("suspicion", sentence)
    for kind, sentence in before.items():
        if kind not in after:
            yield _Found("suspicion_cleared", sentence)


def _kind(sentence: str) -> str:
    """Return the constant part of a suspicion's sentence."""
    return next((suspect.text for suspect in InputFault if sentence.endswith(suspect.text)), sentence)


def _checkpoint(was: str, health: Health) -> Iterator[_Found]:
    failed, fails = was.startswith(NOT_SAVED), health.checkpoint.startswith(NOT_SAVED)
    if fails and not failed:
        yield _Found("checkpoint_fails", health.checkpoint)
    elif failed and not fails:
        yield _Found("checkpoint_saved", health.checkpoint)
