"""Events of a pack for the topic ``event``, from the differences between successive snapshots."""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from typing import Literal, NamedTuple

from pydantic import Field

from bms_estimator.model.input_faults import InputFault
from bms_estimator.model.payloads.health import AnchorReport, FitReport, Health, Payload
from bms_estimator.model.payloads.snapshot import Alarm, Snapshot

MIN_UNSEEN_S = 1.0
"""Minimum duration of a gap that causes an event [s]. Shorter gaps only count in ``health``."""
MAX_NAMES = 4
"""Maximum number of alarms that an event names, so that the reason after them is seen."""
NOT_SAVED = ("cannot be saved", "not saved")
"""Prefixes of ``health.checkpoint`` that report a failed checkpoint."""

EventName = Literal[
    "start",
    "unseen",
    "sensor_offline",
    "sensor_online",
    "suspicion",
    "suspicion_cleared",
    "full",
    "empty",
    "soc_reinitialized",
    "pack_fitted",
    "checkpoint_fails",
    "checkpoint_saved",
    "alarm_raised",
    "alarm_cleared",
    "alarm_unwatched",
    "alarm_watched",
]


class Event(Payload):
    """Topic ``event``, not retained: one event of a pack."""

    time: str = Field(description="time of detection, ISO 8601, UTC")
    name: EventName = Field(description="kind of event")
    text: str = Field(description="description: reason and remedy")
    anchor: AnchorReport | None = Field(
        default=None, description="SOC before and after the correction; null unless the name is full or empty"
    )
    fit: FitReport | None = Field(
        default=None, description="SOC and capacity before and after a fit; null unless the name is pack_fitted"
    )


class EventText(NamedTuple):
    """Content of an event."""

    name: EventName
    text: str
    anchor: AnchorReport | None = None
    fit: FitReport | None = None


def events(before: Snapshot | None, snapshot: Snapshot) -> list[Event]:
    """Return the events between two snapshots.

    Args:
        before: Previous snapshot; None: the service has just started.
        snapshot: Present snapshot.
    """
    health = snapshot.health
    if before is None:
        started = EventText("start", f"checkpoint: {health.checkpoint}")
        # at the start ``health.unseen_s`` is the gap between the runs; None: no gap, or an unknown length
        texts = [started, *_gap_event(health.unseen_s or 0.0), *_sensor_events(None, health)]
        texts += [*input_fault_events([], health.suspects), *_checkpoint_events("", health)]
    elif before.health is health:
        texts = []
    else:
        previous = before.health
        # the total counts all gaps since the previous snapshot; ``health.unseen_s`` is only the last gap
        gaps = _gap_event(health.total.unseen_s - previous.total.unseen_s)
        texts = [*gaps, *_sensor_events(previous, health), *input_fault_events(previous.suspects, health.suspects)]
        texts += _checkpoint_events(previous.checkpoint, health)
        texts += soc_events(previous.identifier, health.identifier, health.anchor)
        texts += _fit_events(previous, health)
    health_events = [Event(time=health.publish_time, **text._asdict()) for text in texts]
    # alarms are evaluated for each snapshot, but several snapshots may share one ``health``
    alarm_time = snapshot.estimate.publish_time if snapshot.estimate else health.publish_time
    return health_events + [Event(time=alarm_time, **text._asdict()) for text in _alarm_events(before, snapshot)]


def _alarm_events(before: Snapshot | None, snapshot: Snapshot) -> Iterator[EventText]:
    """Yield raised and cleared alarms.

    An alarm that was cleared and raised again between the snapshots has another ``since``. Alarms that were raised before
    the start are skipped, because the previous run reported them.
    """
    previous = {alarm.name: alarm for alarm in before.alarms} if before else {}
    for alarm in snapshot.alarms:
        since = previous[alarm.name].since if alarm.name in previous else None
        if since is not None and since != alarm.since:
            yield EventText("alarm_cleared", alarm.name)
        if alarm.since is not None and since != alarm.since and alarm.since >= snapshot.info.started:
            yield EventText("alarm_raised", f"{alarm.name}: {alarm.text}")
    yield from watch_events(
        a for a in snapshot.alarms if a.watched == (a.name in previous and not previous[a.name].watched)
    )


def watch_events(alarms: Iterable[Alarm]) -> Iterator[EventText]:
    """Yield the events of alarms whose quantities have become unavailable or available: one event for each reason."""
    names = defaultdict[str | None, list[str]](list)
    for alarm in alarms:
        names[alarm.unwatched_reason].append(alarm.name)
    for reason, group in names.items():
        rest = f" and {len(group) - MAX_NAMES} more" if len(group) > MAX_NAMES else ""
        listed = ", ".join(group[:MAX_NAMES]) + rest
        text = listed if len(group) == 1 else f"{len(group)} alarms ({listed})"
        yield EventText("alarm_watched", text) if reason is None else EventText("alarm_unwatched", f"{text}: {reason}")


def _gap_event(gap_s: float) -> Iterator[EventText]:
    if gap_s >= MIN_UNSEEN_S:
        # after a kill, the estimate also lacks the samples since the last checkpoint, which did arrive
        yield EventText("unseen", f"the estimate has no measurements of the last {gap_s:.1f} s")


def _sensor_events(previous: Health | None, health: Health) -> Iterator[EventText]:
    if previous is not None and previous.sensor_online == health.sensor_online:
        return
    if health.sensor_online:
        yield EventText("sensor_online", "samples arrive")
    elif previous is not None:  # an offline sensor at the start causes no event
        yield EventText("sensor_offline", health.sensor_message or "")


def input_fault_events(previous: list[str], present: list[str]) -> Iterator[EventText]:
    """Yield input faults that began and ended. The numbers in a fault's text may change without an event."""
    before, after = ({_fault_text(sentence): sentence for sentence in sentences} for sentences in (previous, present))
    for fault_text, sentence in after.items():
        if fault_text not in before:
            yield EventText("suspicion", sentence)
    for fault_text, sentence in before.items():
        if fault_text not in after:
            yield EventText("suspicion_cleared", sentence)


def _fault_text(sentence: str) -> str:
    """Return the constant part of an input fault's text."""
    return next((fault.text for fault in InputFault if sentence.endswith(fault.text)), sentence)


def soc_events(
    previous: Mapping[str, int], counters: Mapping[str, int], anchor: AnchorReport | None
) -> Iterator[EventText]:
    """Yield the reasons of jumps of the SOC.

    Args:
        previous: Earlier counters, as from ``telemetry.health.identifier_counters``.
        counters: Present counters.
        anchor: Last end of a charge or discharge; None without one.
    """

    def has_increased(name: str) -> bool:
        return counters.get(name, 0) > previous.get(name, 0)

    if anchor is not None and (has_increased("full_anchors") or has_increased("empty_anchors")):
        yield EventText(anchor.kind, _anchor_text(anchor), anchor)
    if has_increased("searched"):
        yield EventText(
            "soc_reinitialized",
            "the voltage contradicted the SOC for minutes; the SOC is estimated again with a std of 20 %",
        )
    if has_increased("reset"):
        yield EventText("soc_reinitialized", "a value of the filter was not finite; its last good state was restored")


def _fit_events(previous: Health, health: Health) -> Iterator[EventText]:
    """Yield a fit of the pack's model that changed SOC or capacity."""
    before, model = previous.pack_model, health.pack_model
    if model is None or model.change is None or (before is not None and before.changes >= model.changes):
        return
    yield fit_event(model.change)


def fit_event(change: FitReport) -> EventText:
    """Return the event of a fit of the pack's model that changed SOC or capacity."""
    before, after = (f"{100.0 * each:.1f}" for each in (change.soc_before, change.soc_after))
    soc = "" if before == after else f"the SOC from {before} to {after} % and "
    text = (
        f"the fit to the pack's history changed {soc}the capacity from {change.capacity_before_ah:.4g} to "
        f"{change.capacity_after_ah:.4g} Ah"
    )
    return EventText("pack_fitted", text, fit=change)


def _anchor_text(anchor: AnchorReport) -> str:
    """Return the cause of an anchor, and what it changed."""
    if anchor.kind == "full":
        cause = "the charger ended at the full voltage"
    else:
        cause = "the discharge ended at the cut-off voltage"
    soc, std, after = (f"{100.0 * each:.1f} %" for each in (anchor.soc_before, anchor.soc_std_before, anchor.soc_after))
    result = "unchanged" if soc == after else f"corrected to {after}"
    return f"{cause}: SOC {soc} (std {std}), {result}"


def _checkpoint_events(previous: str, health: Health) -> Iterator[EventText]:
    """Yield a change between success and failure of checkpoints; ``previous`` is the earlier ``health.checkpoint``."""
    failed_before, fails = previous.startswith(NOT_SAVED), health.checkpoint.startswith(NOT_SAVED)
    if fails and not failed_before:
        yield EventText("checkpoint_fails", health.checkpoint)
    elif failed_before and not fails:
        yield EventText("checkpoint_saved", health.checkpoint)
