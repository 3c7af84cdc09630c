"""Hooks that run a program or publish a message for each change of an alarm."""

import asyncio
import contextlib
import json
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from string import Template
from typing import Literal, NamedTuple

import structlog

from bms_estimator.model.payloads.snapshot import Alarm
from bms_estimator.mqtt.connection import OnResult
from bms_estimator.process.runtime import Backoff
from bms_estimator.service.hook import Hook
from bms_estimator.service.hook_process import StartError, program_environment, run_program
from bms_estimator.settings.alarms import AlarmHook, HookEvent

FIRST_RETRY_S = 0.5
"""First delay before the retry of a program that could not be started [s]. Each retry doubles the delay, up to 30 s."""

PublishRaw = Callable[[str, bytes, OnResult], None]
"""Publishes a payload on a topic, and calls back with the result."""

State = Literal["raised", "cleared"]
_ANY = ""
"""Key of the job about all alarms of a hook together."""
_EVENTS_OF_ANY: dict[State, HookEvent] = {"raised": "first_raised", "cleared": "last_cleared"}

log = structlog.get_logger(__name__)


class Job(NamedTuple):
    """Job of a hook: one change to report."""

    alarm: Alarm
    state: State
    key: str
    """Name of the alarm, or ``_ANY``."""


class HookJobs:
    """Waiting jobs: at most one for each alarm, and one for all alarms together.

    A change that undoes a waiting job removes it, because the program or the device already has the present state. A hook
    without ``cleared`` and ``last_cleared`` reports a raised alarm even if the alarm has ended, so that it is not missed.

    Args:
        on: Events that cause a job.
        raised: Alarms of the hook that count as raised, by name. The owner updates it before it calls a method.
    """

    def __init__(self, on: Sequence[HookEvent], raised: Mapping[str, Alarm]) -> None:
        self._on, self._raised = on, raised
        self._reports_cleared = "cleared" in on or "last_cleared" in on
        self._waiting: dict[str, Job] = {}

    def add(self, alarm: Alarm) -> None:
        """Add or remove the jobs that follow from an alarm that was raised or cleared."""
        state: State = "raised" if alarm.name in self._raised else "cleared"
        self._add(Job(alarm, state, alarm.name), state)
        if not self._raised.keys() - {alarm.name}:  # the first raised or the last cleared alarm
            self._add(Job(alarm, state, _ANY), _EVENTS_OF_ANY[state])

    def _add(self, job: Job, event: HookEvent) -> None:
        waiting = self._waiting.get(job.key)
        if waiting is None:
            if event in self._on:
                self._waiting[job.key] = job
        elif self._reports_cleared or waiting.state == "cleared":
            del self._waiting[job.key]

    def next(self) -> Job | None:
        """Return the next job: critical alarms first, then the oldest; None if no job is waiting."""
        return min(
            map(self._with_newest_alarm, self._waiting.values()),
            key=lambda job: job.alarm.severity != "critical",
            default=None,
        )

    def pop(self) -> Job | None:
        """Remove and return the next job; None if no job is waiting."""
        if (job := self.next()) is not None:
            del self._waiting[job.key]
        return job

    def put_back(self, job: Job) -> None:
        """Put back a job that was not done. If its alarm has changed back, drop the job and the waiting opposite job."""
        is_raised = job.key in self._raised if job.key else bool(self._raised)
        if is_raised != (job.state == "raised"):
            if self._reports_cleared:
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


class JobHook(Hook):
    """Hook that runs its jobs one after the other.

    Args:
        settings: Settings of the hook.
        device: Name of the pack.
    """

    def __init__(self, settings: AlarmHook, device: str) -> None:
        super().__init__(settings)
        self._device = device
        self._jobs = HookJobs(settings.on, self._raised)
        self._is_running = False  # also remains True if the shutdown cancels the running job

    @property
    def is_busy(self) -> bool:
        """True while a job is running or waiting."""
        return self._is_running or self._jobs.next() is not None

    def _on_transition(self, alarm: Alarm) -> None:
        self._jobs.add(alarm)

    async def _run_jobs(self) -> None:
        """Run jobs until the hook is closed. A job whose program cannot be started is retried until its alarm changes."""
        while True:
            self._wake.clear()
            backoff = Backoff(FIRST_RETRY_S)
            while (job := self._jobs.pop()) is not None:
                if self.settings.dry_run:
                    log.warning("alarm hook, dry run", would=self.description, alarm=job.alarm.name, state=job.state)
                    continue
                self._is_running = True
                is_started = await self._run_job(job)
                self._is_running = False
                if is_started:
                    backoff.reset()
                else:
                    await self._retry_later(job, backoff.next_s())
            if self._closing:
                return
            await self._wake.wait()

    async def _retry_later(self, job: Job, pause_s: float) -> None:
        """Put a job back, and wait for ``pause_s``, or until another job is more urgent or this one is no longer due."""
        if not self._closing:
            self._jobs.put_back(job)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(pause_s):
                while not self._closing and (first := self._jobs.next()) is not None and first.key == job.key:
                    self._wake.clear()
                    await self._wake.wait()
        if not self._jobs.is_waiting(job):
            log.warning("alarm hook: the program was never started", hook=self.description, alarm=job.alarm.name)

    @abstractmethod
    async def _run_job(self, job: Job) -> bool:
        """Run a job. Return False if its program could not be started."""

    def _succeed(self) -> None:
        self.done += 1
        self.error = ""

    def _fail(self, job: Job, error: str) -> None:
        """Count a failure. A failed job for ``hook_failed`` does not raise ``hook_failed`` again, which would cause endless jobs."""
        self.failures += 1
        if job.alarm.name != "hook_failed":
            self.error = error

    def _fields(self, job: Job) -> dict[str, str]:
        """Return the fields for a program or a payload; a field without a value is empty."""
        alarm, raised = job.alarm, list(self._raised)
        values = {name: getattr(alarm, name) for name in ("name", "severity", "since", "value", "limit", "unit")}
        fields = {name: "" if value is None else str(value) for name, value in values.items()}
        return fields | {
            "text": alarm.text or alarm.unwatched_reason or "",
            "device": self._device,
            "state": job.state,
            "raised": " ".join(raised),
            "json": json.dumps(alarm.model_dump() | {"raised": raised}),
        }


class CommandHook(JobHook):
    """Runs a program with the alarm as JSON on its standard input and with the fields of the alarm in its environment."""

    @property
    def description(self) -> str:
        """Description with the name of the program."""
        return f"run {(self.settings.run or ('',))[0]}"

    async def _run_job(self, job: Job) -> bool:
        """Run the program once. Return False if it could not be started."""
        fields = self._fields(job)
        stdin, timeout_s = fields.pop("json").encode(), self.settings.timeout_s
        variables = program_environment(self.settings.pass_environment, fields)
        try:
            code = await run_program(self.settings.run or (), stdin, variables, timeout_s)
        except StartError as error:
            self._fail(job, f"cannot be started: {error}")
            log.warning("alarm hook: the program cannot be started", hook=self.description, error=str(error))
            return False
        if code is None:
            self._fail(job, f"took longer than {timeout_s:g} s")
            log.warning("alarm hook: the program takes too long and is killed", hook=self.description)
        elif code:
            self._fail(job, f"exit code {code}")
            log.warning("alarm hook: the program has failed", hook=self.description, exit_code=code)
        else:
            self._succeed()
        return True


class PublishHook(JobHook):
    """Publishes a message. The job is done once the broker has acknowledged the message.

    Args:
        settings: Settings of the hook.
        device: Name of the pack.
        topic: Topic of the messages.
        publish: Publishes a message.
    """

    def __init__(self, settings: AlarmHook, device: str, topic: str, publish: PublishRaw) -> None:
        super().__init__(settings, device)
        self._topic, self._publish = topic, publish
        self._backoff = Backoff(FIRST_RETRY_S)
        self._newest: dict[str, Job] = {}  # the last published job by key
        self._unfinished: set[asyncio.Task[None]] = set()  # one task for each message without a final result

    @property
    def description(self) -> str:
        """Description with the topic."""
        return f"publish on {self._topic}"

    @property
    def is_busy(self) -> bool:
        """True while a job is waiting, or a message is not acknowledged."""
        return super().is_busy or bool(self._unfinished)

    async def _run_job(self, job: Job) -> bool:
        """Queue the message at once, so that a shutdown saves it, and await its result in a task."""
        result: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        payload = Template(self.settings.payload).substitute(self._fields(job)).encode()
        self._newest[job.key] = job
        self._publish(self._topic, payload, result.set_result)
        task = asyncio.create_task(self._await_result(job, result), name="alarm hook message")
        self._unfinished.add(task)
        task.add_done_callback(self._unfinished.discard)
        return True

    async def _await_result(self, job: Job, result: asyncio.Future[str]) -> None:
        """Await the result of a message. Repeat the newest job of an alarm after a rejection or loss, if it is still due."""
        if not (await asyncio.wait([result], timeout=self.settings.timeout_s))[0]:
            self._fail_with_log(
                job, f"not acknowledged by the broker within {self.settings.timeout_s:g} s; still queued"
            )
            await asyncio.wait([result])  # unlike awaiting the future, this does not cancel it at a shutdown
        if reason := result.result():
            self._fail_with_log(job, f"not delivered: {reason}")
            await asyncio.sleep(self._backoff.next_s())
            if job is self._newest[job.key]:
                self._jobs.put_back(job)
            self._wake.set()
        else:
            self._succeed()
            self._backoff.reset()

    def _fail_with_log(self, job: Job, error: str) -> None:
        if error != self.error:  # each retry of a denied message fails
            log.warning("alarm hook: a message is not delivered", hook=self.description, reason=error)
        self._fail(job, error)
