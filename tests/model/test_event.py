"""Events from the differences between two successive snapshots."""

import itertools
from typing import Any

from bms_estimator.model.cell import load_cell
from bms_estimator.model.events import events, watch_events
from bms_estimator.model.input_faults import InputFault
from bms_estimator.model.payloads.health import AnchorReport
from bms_estimator.model.payloads.snapshot import Snapshot
from bms_estimator.settings.alarm_limits import monitored_alarms
from bms_estimator.settings.pack import Settings
from bms_estimator.telemetry.alarms.definitions import AlarmMessage, alarm_payload
from tests.sinks.snapshots import CELL_SNAPSHOT

AT_41_C = f"no data at 41 C, the cell file knows 25 C: {InputFault.TEMPERATURE.text}"
AT_42_C = f"no data at 42 C, the cell file knows 25 C: {InputFault.TEMPERATURE.text}"


def with_health(**changes: Any) -> Snapshot:
    """Return a snapshot with changed fields of its health message."""
    return CELL_SNAPSHOT._replace(health=CELL_SNAPSHOT.health.model_copy(update=changes))


def event_names(before: Snapshot | None, after: Snapshot) -> list[str]:
    """Return the names of the events between two snapshots."""
    return [event.name for event in events(before, after)]


def with_gap_total(seconds: float) -> Snapshot:
    """Return a snapshot with a total duration of gaps [s]."""
    return with_health(total=CELL_SNAPSHOT.health.total.model_copy(update={"unseen_s": seconds}))


def test_a_start_event_contains_the_outcome_of_the_checkpoint():
    start, *_ = events(None, with_health(checkpoint="restored: SOC 0.5"))
    assert (start.name, start.text) == ("start", "checkpoint: restored: SOC 0.5")


def test_an_event_names_the_first_alarms_of_many() -> None:
    kinds = monitored_alarms(Settings(), load_cell("ncr18650"))[:6]
    message = AlarmMessage(None, cause_cleared=False, reasons=(), unwatched_reason="no board", unknown_reason=None)
    names = [kind.name for kind in kinds]
    (event,) = watch_events(alarm_payload(kind, message) for kind in kinds)
    assert event.text == f"6 alarms ({', '.join(names[:4])} and 2 more): no board"


def test_a_start_without_a_sensor_causes_no_offline_event():
    without_sensor = with_health(sensor_online=False, sensor_message="no board")
    assert event_names(None, without_sensor) == ["start"]
    assert event_names(without_sensor, with_health(sensor_online=True)) == ["sensor_online"]


def test_a_lost_sensor_causes_one_event_with_the_reason():
    sensor_lost = with_health(sensor_online=False, sensor_message="no board")
    [event] = events(CELL_SNAPSHOT, sensor_lost)
    assert (event.name, event.text, event.time) == ("sensor_offline", "no board", sensor_lost.health.publish_time)
    assert event_names(sensor_lost, with_health(sensor_online=False, sensor_message="silent for 9 s")) == []


def test_a_diagnostic_causes_an_event_at_its_start_and_end_but_not_if_its_numbers_change():
    states = [with_health(suspects=suspects) for suspects in ([], [AT_41_C], [AT_42_C], [AT_42_C, "x"], ["x"], [])]
    events_of_changes = [events(*pair) for pair in itertools.pairwise(states)]
    assert [[(event.name, event.text) for event in changes] for changes in events_of_changes] == [
        [("suspicion", AT_41_C)],
        [],
        [("suspicion", "x")],
        [("suspicion_cleared", AT_42_C)],
        [("suspicion_cleared", "x")],
    ]


def test_failed_and_recovered_checkpoints_cause_events():
    states = ["saved", "cannot be saved: full", "not saved: the disk hangs", "saved", "saved"]
    events_of_changes = [
        event_names(with_health(checkpoint=a), with_health(checkpoint=b)) for a, b in itertools.pairwise(states)
    ]
    assert events_of_changes == [["checkpoint_fails"], [], ["checkpoint_saved"], []]


def test_a_gap_causes_an_event_with_its_duration():
    [event] = events(with_gap_total(2.0), with_gap_total(14.5))
    assert (event.name, event.text) == ("unseen", "the estimate has no measurements of the last 12.5 s")
    assert events(with_gap_total(2.0), with_gap_total(2.5)) == []


def test_a_gap_before_the_start_causes_one_event():
    after_gap = with_health(unseen_s=3600.0, total=with_gap_total(3600.0).health.total)
    assert [(event.name, event.text) for event in events(None, after_gap)][:2] == [
        ("start", f"checkpoint: {CELL_SNAPSHOT.health.checkpoint}"),
        ("unseen", "the estimate has no measurements of the last 3600.0 s"),
    ]
    assert events(after_gap, with_gap_total(3600.0)) == []
    assert "unseen" not in event_names(None, with_health(unseen_s=None, total=with_gap_total(60.0).health.total))
    assert "unseen" not in event_names(None, with_health(unseen_s=0.5))


def test_equal_snapshots_cause_no_events():
    assert events(CELL_SNAPSHOT, CELL_SNAPSHOT) == []
    assert events(CELL_SNAPSHOT, with_health()) == []


def with_counters(anchor: AnchorReport | None = None, **counters: int) -> Snapshot:
    """Return a snapshot with an anchor and counters of the identifier."""
    return with_health(anchor=anchor, identifier=CELL_SNAPSHOT.health.identifier | counters)


def test_an_anchor_causes_an_event_with_the_soc_before_and_after_it():
    full = AnchorReport(kind="full", soc_before=0.932, soc_std_before=0.021, soc_after=0.991)
    empty = AnchorReport(kind="empty", soc_before=0.0004, soc_std_before=0.02, soc_after=0.0)
    states = [
        with_counters(full, full_anchors=1),
        with_counters(full, full_anchors=2),
        with_counters(full, full_anchors=2),
        with_counters(empty, full_anchors=2, empty_anchors=1),
    ]
    events_of_changes = [events(*pair) for pair in itertools.pairwise(states)]
    assert [[(event.name, event.text, event.anchor) for event in changes] for changes in events_of_changes] == [
        [("full", "the charger ended at the full voltage: SOC 93.2 % (std 2.1 %), corrected to 99.1 %", full)],
        [],
        [("empty", "the discharge ended at the cut-off voltage: SOC 0.0 % (std 2.0 %), unchanged", empty)],
    ]
    assert "full" not in event_names(None, states[0]), "the anchor of an earlier run causes no event"


def test_a_reinitialized_soc_causes_an_event_with_the_reason():
    [event] = events(with_counters(searched=1), with_counters(searched=2))
    assert (event.name, event.text.split(";")[0]) == (
        "soc_reinitialized",
        "the voltage contradicted the SOC for minutes",
    )
    [event] = events(with_counters(reset=0), with_counters(reset=1))
    assert (event.name, event.text.split(";")[0]) == ("soc_reinitialized", "a value of the filter was not finite")
