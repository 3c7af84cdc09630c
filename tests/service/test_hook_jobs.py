"""Waiting jobs of a hook."""

from typing import TYPE_CHECKING

import pytest

from bms_estimator.service.job_hook import HookJobs
from bms_estimator.settings.alarms import HookEvent
from tests.sinks.snapshots import SOC_LOW_ALARM

if TYPE_CHECKING:
    from bms_estimator.model.payloads.snapshot import Alarm


class Hook:
    """Jobs of a hook, whose alarms tests raise and clear."""

    def __init__(self, *on: HookEvent) -> None:
        self._raised: dict[str, Alarm] = {}
        self.jobs = HookJobs(on, self._raised)

    def change(self, *changes: str) -> None:
        """Raise (``+name``) or clear (``-name``) alarms. Those with a name in capitals are critical."""
        for change in changes:
            name, is_raised = change[1:], change[0] == "+"
            severity = "critical" if name.isupper() else "warning"
            alarm = SOC_LOW_ALARM.model_copy(update={"name": name, "severity": severity, "active": is_raised})
            if is_raised:
                self._raised[name] = alarm
            else:
                del self._raised[name]
            self.jobs.add(alarm)

    def take_all(self) -> str:
        """Take all jobs. Return them as text, in their order."""
        taken = []
        while job := self.jobs.pop():
            taken.append(("+" if job.state == "raised" else "-") + job.alarm.name)
        return " ".join(taken)


@pytest.mark.parametrize(
    ("on", "steps"),
    [
        # each step: changes, then the jobs that are taken after them
        (("raised", "cleared"), [("+a -a +a +b -b", "+a"), ("-a +a", ""), ("-a +B +c", "+B -a +c")]),
        (("raised",), [("+a -a", "+a"), ("+a", "+a"), ("-a +a", "+a"), ("-a", ""), ("+a -a +B +a -a", "+B +a")]),
        (("first_raised",), [("+a -a", "+a"), ("+a +b -a -b +B", "+B"), ("-B", "")]),
        (("cleared",), [("+a -a", "-a"), ("+a", ""), ("-a +a", ""), ("-a", "-a")]),
        (
            ("first_raised", "last_cleared"),
            [("+a +b", "+a"), ("-a", ""), ("-b +b", ""), ("-b", "-b"), ("+a -a", ""), ("+a +B", "+B"), ("-B -a", "-a")],
        ),
        # the first raised alarm has ended before its job was taken
        (("first_raised", "last_cleared"), [("+a +b -a", "+b"), ("-b", "-b")]),
        (("raised", "last_cleared"), [("+a +b", "+a +b"), ("-a", ""), ("-b", "-b")]),
    ],
)
def test_each_alarm_has_one_job_with_its_newest_state(on: tuple[HookEvent, ...], steps: list[tuple[str, str]]) -> None:
    hook = Hook(*on)
    for changes, taken in steps:
        hook.change(*changes.split())
        assert hook.take_all() == taken


@pytest.mark.parametrize(("changes", "taken"), [("", "+a"), ("-a", ""), ("-a +a", "+a"), ("-a +a -a", "+a")])
def test_a_hook_without_ends_reports_a_second_alarm_if_the_job_of_the_first_was_not_done(
    changes: str, taken: str
) -> None:
    hook = Hook("raised")
    hook.change("+a")
    job = hook.jobs.pop()
    assert job is not None
    hook.change(*changes.split())
    hook.jobs.put_back(job)
    assert hook.take_all() == taken


@pytest.mark.parametrize("on", [("raised", "cleared"), ("first_raised", "last_cleared")])
@pytest.mark.parametrize(("changes", "taken"), [("", "+a"), ("-a", ""), ("-a +a", "+a"), ("-a +a -a", "")])
def test_a_job_that_was_not_done_is_put_back_only_while_its_alarm_has_not_ended(
    on: tuple[HookEvent, ...], changes: str, taken: str
) -> None:
    hook = Hook(*on)
    hook.change("+a")
    job = hook.jobs.pop()
    assert job is not None
    hook.change(*changes.split())
    hook.jobs.put_back(job)
    assert hook.jobs.is_waiting(job) == bool(taken)
    assert hook.take_all() == taken
