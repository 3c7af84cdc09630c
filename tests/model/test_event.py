"""Events from the differences between two snapshots."""

import itertools
from typing import Any

from bms_estimator.model.events import events
from bms_estimator.model.input_faults import InputFault
from bms_estimator.model.payloads import Snapshot
from tests.sinks.snapshots import ONE

WARM = f"no data at 41 C, the cell file knows 25 C: {InputFault.TEMPERATURE.text}"
WARMER = f"no data at 42 C, the cell file knows 25 C: {InputFault.TEMPERATURE.text}"


def with_health(**changes: Any) -> Snapshot:
    return ONE._replace(health=ONE.health.model_copy(update=changes))


def names(before: Snapshot | None, after: Snapshot) -> list[str]:
    return [event.name for event in events(before, after)]


def unseen(seconds: float) -> Snapshot:
    return with_health(total=ONE.health.total.model_copy(update={"unseen_s": seconds}))


def test_a_start_event_contains_the_outcome_of_the_checkpoint():
    start, *_ = events(None, with_health(checkpoint="restored: SOC 0.5"))
    assert (start.name, start.text) == ("start", "checkpoint: restored: SOC 0.5")


def test_a_start_without_a_sensor_causes_no_offline_event():
    silent = with_health(sensor_online=False, sensor_message="no board")
    assert names(None, silent) == ["start"]
    assert names(silent, with_health(sensor_online=True)) == ["sensor_online"]


def test_a_lost_sensor_causes_one_event_with_its_reason():
    lost = with_health(sensor_online=False, sensor_message="no board")
    [event] = events(ONE, lost)
    assert (event.name, event.text, event.time) == ("sensor_offline", "no board", lost.health.publish_time)
    assert names(lost, with_health(sensor_online=False, sensor_message="silent for 9 s")) == []


def test_diagnostics_cause_events_at_start_and_end_but_not_for_changed_numbers():
    states = [with_health(suspects=suspects) for suspects in ([], [WARM], [WARMER], [WARMER, "x"], ["x"], [])]
    told = [events(*pair) for pair in itertools.pairwise(states)]
    assert [[(event.name, event.text) for event in each] for each in told] == [
        [("suspicion", WARM)],
        [],
        [("suspicion", "x")],
        [("suspicion_cleared", WARMER)],
        [("suspicion_cleared", "x")],
    ]


def test_failed_and_recovered_checkpoints_cause_events():
    states = ["saved", "cannot be saved: full", "not saved: the disk hangs", "saved", "saved"]
    told = [names(with_health(checkpoint=a), with_health(checkpoint=b)) for a, b in itertools.pairwise(states)]
    assert told == [["checkpoint_fails"], [], ["checkpoint_saved"], []]


def test_a_gap_causes_an_event_with_its_duration():
    [event] = events(unseen(2.0), unseen(14.5))
    assert (event.name, event.text) == ("unseen", "no measurements for 12.5 s")
    assert events(unseen(2.0), unseen(2.5)) == []


def test_a_gap_before_the_start_causes_one_event():
    at_once = with_health(unseen_s=3600.0, total=unseen(3600.0).health.total)
    assert [(event.name, event.text) for event in events(None, at_once)][:2] == [
        ("start", f"checkpoint: {ONE.health.checkpoint}"),
        ("unseen", "no measurements for 3600.0 s"),
    ]
    assert events(at_once, unseen(3600.0)) == []
    assert "unseen" not in names(None, with_health(unseen_s=None, total=unseen(60.0).health.total))
    assert "unseen" not in names(None, with_health(unseen_s=0.5))


def test_equal_snapshots_cause_no_events():
    assert events(ONE, ONE) == []
    assert events(ONE, with_health()) == []
