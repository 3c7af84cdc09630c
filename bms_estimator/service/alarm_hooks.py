"""Alarm hooks: actions when an alarm is raised or ends. Each hook runs in a task of its own and delays nothing else."""

import asyncio
import contextlib
import shutil
from collections import deque
from collections.abc import Awaitable, Callable, Collection, Sequence
from string import Template
from typing import Literal, NamedTuple, Self

import structlog

from bms_estimator.model.errors import UserError
from bms_estimator.model.payloads.alarm import Alarm
from bms_estimator.model.payloads.health import HookHealth
from bms_estimator.process.backoff import Backoff
from bms_estimator.protocols.base.relay import Relay
from bms_estimator.service.hook_process import StartError, program_environment, run_program
from bms_estimator.settings.alarms import AlarmHook
from bms_estimator.settings.pack import Settings
from bms_estimator.telemetry.alarms.message import Change

MAX_JOBS = 100
"""Maximum number of queued jobs of a hook. If a slow program causes more, the oldest job is dropped."""
RELAY_S = 2.0
"""Interval between two relay commands [s]. They are repeated because the board may have been reset or replaced."""
RELAY_RETRY_S = 0.5
"""Interval between attempts after a failed relay command [s]."""
CLOSE_S = 2.0
"""Timeout of running hooks at shutdown [s]."""
FIRST_RETRY_S = 0.5
"""First delay before the retry of a program that could not be started [s]. Each retry doubles the delay, up to 30 s. After
an internal error, a hook also waits for this time."""

PublishRaw = Callable[[str, bytes], None]
"""Publishes a payload on a topic."""
SetRelay = Callable[[Relay], Awaitable[None]]
"""Sends the level of the relay to the board. Raises UserError if the board does not confirm it."""

log = structlog.get_logger(__name__)


class Job(NamedTuple):
    """Job of a hook: one change of an alarm to report."""

    alarm: Alarm
    state: Literal["raised", "cleared"]


class AlarmHooks:
    """All hooks of a pack; a context manager.

    Args:
        hooks: Configured hooks.
        device: Name of the pack.
        publish: Publishes a message; None without a broker.
        set_relay: Switches the relay; None without a relay.

    Raises:
        UserError: A hook needs something that is missing.
    """

    def __init__(
        self, hooks: Sequence[AlarmHook], device: str, publish: PublishRaw | None, set_relay: SetRelay | None
    ) -> None:
        self._hooks = [_make_hook(i, hook, device, publish, set_relay) for i, hook in enumerate(hooks)]
        self._tasks: list[asyncio.Task[None]] = []

    @property
    def health(self) -> HookHealth | None:
        """Successes and failures since start; None without hooks."""
        if not self._hooks:
            return None
        return HookHealth(
            done=sum(hook.done for hook in self._hooks),
            failures=sum(hook.failures for hook in self._hooks),
            failing=[f"{hook.description}: {hook.error}" for hook in self._hooks if hook.error],
        )

    def on_alarm_change(self, change: Change) -> None:
        """Pass a change of an alarm to its hooks; returns at once."""
        for hook in self._hooks:
            if hook.covers(change.alarm.name):
                hook.on_alarm_change(change)

    def restore_active(self, alarms: Sequence[Alarm]) -> None:
        """Restore the alarms of an earlier run.

        Jobs of these alarms are not repeated, but the relay is set to its level. If a hook had failed in the earlier run,
        all jobs are repeated, so that none is lost.
        """
        raised = {alarm.name for alarm in alarms if _counts_as_raised(alarm)}
        if "hook_failed" not in raised:
            for hook in self._hooks:
                hook.restore_active(raised)
            return
        for hook in self._hooks:
            hook.restore_active({"hook_failed"})  # hook_failed itself is not announced again
        for alarm in alarms:
            self.on_alarm_change(Change(at_s=0.0, alarm=alarm))  # hooks do not use the time

    async def __aenter__(self) -> Self:
        """Start a task for each hook."""
        self._tasks = [asyncio.create_task(hook.run(), name="alarm hook") for hook in self._hooks]
        return self

    async def __aexit__(self, *_error: object) -> None:
        """Wait up to ``CLOSE_S`` for running programs."""
        for hook in self._hooks:
            hook.close()
        if self._tasks:
            _, late = await asyncio.wait(self._tasks, timeout=CLOSE_S)
            for task in late:
                task.cancel()
            await asyncio.gather(*late, return_exceptions=True)


class _Hook:
    """One hook, which runs its jobs one after the other.

    Attributes:
        done: Number of completed jobs since start.
        failures: Number of failed attempts since start.
        error: Reason why the last attempt failed; empty after a success.
    """

    def __init__(self, settings: AlarmHook, device: str) -> None:
        self._settings, self._device = settings, device
        self.done, self.failures, self.error = 0, 0, ""
        self._raised: set[str] = set()
        self._jobs: deque[Job] = deque(maxlen=MAX_JOBS)
        self._wake = asyncio.Event()
        self._closing = False

    @property
    def description(self) -> str:
        """Short description, without the arguments of a program, which may hold secrets."""
        raise NotImplementedError

    def covers(self, name: str) -> bool:
        """Return True if the hook is for this alarm: ``alarm_state_lost`` always, ``hook_failed`` only if listed."""
        if name == "alarm_state_lost":
            return True
        return name in self._settings.alarms if self._settings.alarms else name != "hook_failed"

    def on_alarm_change(self, change: Change) -> None:
        """Queue the job that follows from a change."""
        job = self._record_change(change)
        if job is None or job.state not in self._settings.on:
            return
        if len(self._jobs) == MAX_JOBS:
            log.warning("an alarm hook is too slow: its oldest job is dropped", hook=self.description)
        self._jobs.append(job)

    def restore_active(self, raised: Collection[str]) -> None:
        """Restore the alarms of an earlier run."""
        self._raised = {name for name in raised if self.covers(name)}

    def close(self) -> None:
        """Make the hook end after its queued jobs."""
        self._closing = True
        self._wake.set()

    async def run(self) -> None:
        """Run jobs until the hook is closed. An internal error is logged and counted and does not end the hook."""
        while True:
            try:
                return await self._run_jobs()
            except Exception as error:
                self.failures, self.error = self.failures + 1, f"internal error: {error!r}"
                log.exception("alarm hook: internal error", hook=self.description)
                await asyncio.sleep(FIRST_RETRY_S)

    async def _run_jobs(self) -> None:
        """Run jobs until the hook is closed."""
        while not self._closing or self._jobs:
            await self._wake.wait()
            if not self._closing:  # while it closes, the event stays set and nothing waits
                self._wake.clear()
            while self._jobs:
                job = self._jobs.popleft()
                if self._settings.dry_run:
                    log.warning("alarm hook, dry run", would=self.description, alarm=job.alarm.name, state=job.state)
                else:
                    await self._run_job(job)

    async def _run_job(self, job: Job) -> None:
        raise NotImplementedError

    def _record_change(self, change: Change) -> Job | None:
        """Record a change of an alarm. Return its job, or None if nothing changes for the hook."""
        alarm = change.alarm
        is_raised = _counts_as_raised(alarm)
        if is_raised == (alarm.name in self._raised):
            return None
        self._raised ^= {alarm.name}  # add it if it is absent, otherwise remove it
        self._wake.set()
        return Job(alarm, "raised" if is_raised else "cleared")

    def _is_due(self, job: Job) -> bool:
        """Return True if a job is still needed: the hook is open and the alarm's state has not changed."""
        return not self._closing and (job.alarm.name in self._raised) == (job.state == "raised")

    def _succeed(self) -> None:
        self.done += 1
        self.error = ""

    def _fail(self, job: Job, error: str) -> None:
        """Count a failure. A failed job for ``hook_failed`` does not raise ``hook_failed`` again, which would cause endless jobs."""
        self.failures += 1
        if job.alarm.name != "hook_failed":
            self.error = error


def _counts_as_raised(alarm: Alarm) -> bool:
    """Return True for a raised alarm, and for a critical alarm that cannot be watched and might have to be raised."""
    return alarm.active or (alarm.severity == "critical" and not alarm.watched)


class _CommandHook(_Hook):
    """Runs a program with the alarm as JSON on its standard input and with the fields of the alarm in its environment."""

    @property
    def description(self) -> str:
        """Description with the name of the program."""
        return f"run {(self._settings.run or ('',))[0]}"

    async def _run_job(self, job: Job) -> None:
        """Run the program. If it cannot be started, try again until it starts or the alarm's state changes."""
        backoff = Backoff(FIRST_RETRY_S)
        while not await self._run(job):
            await self._pause(job, backoff.next_s())
            if not self._is_due(job):
                log.warning("alarm hook: the program was never started", hook=self.description, alarm=job.alarm.name)
                return

    async def _pause(self, job: Job, pause_s: float) -> None:
        """Wait before another attempt, at most until the job is no longer due."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(pause_s):
                while self._is_due(job):
                    self._wake.clear()
                    await self._wake.wait()

    async def _run(self, job: Job) -> bool:
        """Run the program once. Return False if it could not be started."""
        fields = _job_fields(job, self._device)
        text, timeout_s = fields.pop("json").encode(), self._settings.timeout_s
        variables = program_environment(self._settings.pass_environment, fields)
        try:
            code = await run_program(self._settings.run or (), text, variables, timeout_s)
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


class _PublishHook(_Hook):
    """Publishes a message."""

    def __init__(self, settings: AlarmHook, device: str, topic: str, publish: PublishRaw) -> None:
        super().__init__(settings, device)
        self._topic, self._publish = topic, publish

    @property
    def description(self) -> str:
        """Description with the topic."""
        return f"publish on {self._topic}"

    async def _run_job(self, job: Job) -> None:
        self._publish(self._topic, Template(self._settings.payload).substitute(_job_fields(job, self._device)).encode())
        self._succeed()


class _RelayHook(_Hook):
    """Hook that keeps the board's relay at its level by repeated commands, because a reset releases it."""

    def __init__(self, settings: AlarmHook, device: str, set_relay: SetRelay) -> None:
        super().__init__(settings, device)
        self._set_relay = set_relay

    @property
    def description(self) -> str:
        """Description with the level of the relay pin."""
        return f"relay pin {'high' if self._command.high else 'low'}"

    @property
    def _command(self) -> Relay:
        """Relay command with the level for the present alarms, and the level for a silent service."""
        level_in_alarm, level_when_silent = self._settings.relay, self._settings.level_when_silent
        high = (level_in_alarm == "high") == bool(self._raised)
        if level_when_silent == "keep":
            return Relay(high, high_when_silent=None)
        return Relay(high, high_when_silent=level_when_silent == "high", silent_s=self._settings.silent_s)

    def on_alarm_change(self, change: Change) -> None:
        """Follow the alarms regardless of the hook's ``on``.

        The pin has the hook's level while at least one alarm counts as raised, otherwise the opposite level.
        """
        before = self._command
        job = self._record_change(change)
        if job is not None and self._command != before:
            log.warning(
                "relay", dry_run=self._settings.dry_run, hook=self.description, alarm=job.alarm.name, state=job.state
            )

    async def _run_jobs(self) -> None:
        """Send the level repeatedly until the hook is closed."""
        while not self._settings.dry_run and not self._closing:
            self._wake.clear()
            try:
                await self._set_relay(self._command)
                if self.error:
                    log.info("the board accepts relay commands again", hook=self.description)
                self.error = ""
            except UserError as error:
                if str(error) != self.error:
                    log.warning("the board does not accept a relay command", hook=self.description, reason=str(error))
                self.failures, self.error = self.failures + 1, str(error)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(RELAY_RETRY_S if self.error else RELAY_S):
                    await self._wake.wait()


def hook_warnings(settings: Settings) -> list[str]:
    """Return one line for each hook whose program is missing, and for each relay without ``when_silent``.

    Raises:
        UserError: A hook needs a missing broker or relay.
    """
    hooks = settings.alarms.hook
    AlarmHooks(  # raises UserError for a hook that cannot work
        hooks, settings.pack.name, _ignore_message if settings.mqtt else None, select_relay(settings, _ignore_relay)
    )
    return [
        f"alarms.hook.{i}.run = {hook.run[0]}: no such program here, or it may not be run"
        for i, hook in enumerate(hooks)
        if hook.run and shutil.which(hook.run[0]) is None
    ] + [
        f"alarms.hook.{i}.when_silent: not set, so the board switches its pin to {hook.relay}, as in an alarm, after "
        f'{hook.silent_s} s without the service; write {hook.relay!r} to confirm, or "keep"'
        for i, hook in enumerate(hooks)
        if hook.relay and hook.when_silent is None
    ]


def select_relay(settings: Settings, set_relay: SetRelay | None) -> SetRelay | None:
    """Return ``set_relay`` if the source has a relay pin, otherwise None. Only the firmware's board has one."""
    return set_relay if settings.sensor.protocol == "binary" else None


def _ignore_message(_topic: str, _payload: bytes) -> None:
    """Do nothing. This function replaces the broker while the hooks are only checked."""


async def _ignore_relay(_: Relay) -> None:
    """Do nothing. This function replaces the relay while the hooks are only checked."""


def _make_hook(i: int, hook: AlarmHook, device: str, publish: PublishRaw | None, set_relay: SetRelay | None) -> _Hook:
    """Return the hook with index ``i`` in the settings.

    Raises:
        UserError: The hook needs a missing broker or relay.
    """
    if hook.topic:
        if publish is None:
            raise UserError(f"alarms.hook.{i}.topic = {hook.topic}: there is no broker; add the section [mqtt]")
        return _PublishHook(hook, device, hook.topic, publish)
    if hook.relay:
        if set_relay is None:
            raise UserError(
                f"alarms.hook.{i}.relay: only the board of [sensor] with protocol = 'binary' has a relay pin"
            )
        return _RelayHook(hook, device, set_relay)
    return _CommandHook(hook, device)


def _job_fields(job: Job, device: str) -> dict[str, str]:
    """Return the fields for a program or a payload; a field without a value is empty."""
    alarm = job.alarm
    values = {name: getattr(alarm, name) for name in ("name", "severity", "since", "value", "limit", "unit")}
    fields = {name: "" if value is None else str(value) for name, value in values.items()}
    text = alarm.text or alarm.unwatched_reason or ""
    return fields | {"text": text, "device": device, "state": job.state, "json": alarm.json_bytes.decode()}
