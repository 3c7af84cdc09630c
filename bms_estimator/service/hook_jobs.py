"""Jobs of a hook that wait for its program or message."""

from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

from bms_estimator.model.payloads.alarm import Alarm
from bms_estimator.settings.alarms import HookEvent

State = Literal["raised", "cleared"]
_ANY = ""
"""Key of the job about all alarms of a hook together."""
_EVENTS_OF_ANY: dict[State, HookEvent] = {"raised": "first_raised", "cleared": "last_cleared"}


class Job(NamedTuple):
    """Job of a hook: one change to report."""

    alarm: Alarm
    state: State
    key: str
    """Name of the alarm, or ``_ANY``."""


class HookJobs:
    """Waiting jobs: at most one for each alarm, and one for all alarms together.

    A change that undoes a waiting job removes it, because the program or the device already has the present state.

    Args:
        on: Events that cause a job.
        raised: Alarms of the hook that count as raised, by name. The owner updates it before it calls a method.
    """

    def __init__(self, on: Sequence[HookEvent], raised: Mapping[str, Alarm]) -> None:
        self._on, self._raised = on, raised
        self._waiting: dict[str, Job] = {}

    def add(self, alarm: Alarm) -> None:
        """Add or remove the jobs that follow from an alarm that was raised or cleared."""
        state: State = "raised" if alarm.name in self._raised else "cleared"
        self._add(Job(alarm, state, alarm.name), state)
        if not self._raised.keys() - {alarm.name}:  # the first raised or the last cleared alarm
            self._add(Job(alarm, state, _ANY), _EVENTS_OF_ANY[state])

    def _add(self, job: Job, event: HookEvent) -> None:
        if self._waiting.pop(job.key, None) is None and event in self._on:
            self._waiting[job.key] = job

    def next(self) -> Job | None:
        """Return the next job: critical alarms first, then the oldest; None if no job is waiting."""
        return min(map(self._with_newest_alarm, self._waiting.values()), key=_is_not_critical, default=None)

    def take(self) -> Job | None:
        """Remove and return the next job; None if no job is waiting."""
        if (job := self.next()) is not None:
            del self._waiting[job.key]
        return job

    def put_back(self, job: Job) -> None:
        """Put back a job that was not done. If its alarm has changed since, neither the job nor its opposite is due."""
        is_raised = job.key in self._raised if job.key else bool(self._raised)
        if is_raised != (job.state == "raised"):
            self._waiting.pop(job.key, None)
        else:
            self._waiting = {job.key: job} | self._waiting

    def is_waiting(self, job: Job) -> bool:
        """Return True if the job, or a newer one of the same kind, is waiting."""
        waiting = self._waiting.get(job.key)
        return waiting is not None and waiting.state == job.state

    def _with_newest_alarm(self, job: Job) -> Job:
        """Return a job with the present content of its alarm. A job for all alarms gets the most severe one."""
        raised = [alarm for alarm in self._raised.values() if job.key in (_ANY, alarm.name)]
        if job.state == "cleared" or not raised:
            return job
        return job._replace(alarm=min(raised, key=lambda alarm: alarm.severity != "critical"))


def _is_not_critical(job: Job) -> bool:
    return job.alarm.severity != "critical"
