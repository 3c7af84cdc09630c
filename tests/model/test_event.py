"""Events from one snapshot to the next."""

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


def test_a_start_says_what_became_of_the_checkpoint():
    start, *_ = events(None, with_health(checkpoint="restored: SOC 0.5"))
    assert (start.name, start.text) == ("start", "checkpoint: restored: SOC 0.5")


def test_a_start_without_a_sensor_is_no_loss_of_it():
    silent = with_health(sensor_online=False, sensor_message="no board")
    assert names(None, silent) == ["start"]
    assert names(silent, with_health(sensor_online=True)) == ["sensor_online"]


def test_a_lost_sensor_is_told_once_with_its_reason():
    lost = with_health(sensor_online=False, sensor_message="no board")
    [event] = events(ONE, lost)
    assert (event.name, event.text, event.time) == ("sensor_offline", "no board", lost.health.publish_time)
    assert names(lost, with_health(sensor_online=False, sensor_message="silent for 9 s")) == []


def test_a_suspicion_is_told_when_it_comes_and_when_it_goes_and_not_when_its_numbers_change():
    states = [with_health(suspects=suspects) for suspects in ([], [WARM], [WARMER], [WARMER, "x"], ["x"], [])]
    told = [events(*pair) for pair in itertools.pairwise(states)]
    assert [[(event.name, event.text) for event in each] for each in told] == [
        [("suspicion", WARM)],
        [],
        [("suspicion", "x")],
        [("suspicion_cleared", WARMER)],
        [("suspicion_cleared", "x")],
    ]


def test_a_checkpoint_that_cannot_be_saved_is_told_and_one_that_can_again():
    states = ["saved", "cannot be saved: full", "not saved: the disk hangs", "saved", "saved"]
    told = [names(with_health(checkpoint=a), with_health(checkpoint=b)) for a, b in itertools.pairwise(states)]
    assert told == [["checkpoint_fails"], [], ["checkpoint_saved"], []]


def test_time_that_nobody_measured_is_told_with_its_length():
    [event] = events(unseen(2.0), unseen(14.5))
    assert (event.name, event.text) == ("unseen", "nobody measured for 12.5 s")
    assert events(unseen(2.0), unseen(2.5)) == []


def test_time_that_nobody_measured_before_the_start_is_told_whether_the_first_health_counts_it_or_a_later_one():
    at_once = with_health(unseen_s=3600.0, total=unseen(3600.0).health.total)
    assert [(event.name, event.text) for event in events(None, at_once)][:2] == [
        ("start", f"checkpoint: {ONE.health.checkpoint}"),
        ("unseen", "nobody measured for 3600.0 s"),
    ]
    assert events(at_once, unseen(3600.0)) == []
    assert "unseen" not in names(None, with_health(unseen_s=None, total=unseen(60.0).health.total))
    assert "unseen" not in names(None, with_health(unseen_s=0.5))


def test_nothing_happens_between_equal_snapshots():
    assert events(ONE, ONE) == []
    assert events(ONE, with_health()) == []
