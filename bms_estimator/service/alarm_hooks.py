"""Actions taken when an alarm is raised, ends or can no longer be watched. Each hook has its own task; nothing waits for it."""

import asyncio
import contextlib
import shutil
from collections import deque
from collections.abc import Awaitable, Callable, Collection, Sequence
from string import Template
from typing import Literal, NamedTuple, Self

import structlog

from bms_estimator.model.errors import UserError
from bms_estimator.model.payloads import Alarm, HookHealth
from bms_estimator.process.backoff import Backoff
from bms_estimator.protocols.base.relay import Relay
from bms_estimator.service.hook_process import StartError, environment, run
from bms_estimator.settings.alarms import AlarmHook
from bms_estimator.settings.pack import Settings
from bms_estimator.telemetry.alarms import Change

WAITING = 100
"""Maximum number of alarms waiting for a slow program; then the oldest is dropped."""
RELAY_S, RETRY_S = 2.0, 0.5
"""Maximum interval between two relay commands, because the board may have been reset or replaced, and retry interval
of a refused one [s]."""
CLOSE_S = 2.0
"""Timeout of running hooks at shutdown [s]."""
FIRST_RETRY_S = 0.5
"""First pause before a program that could not be started is tried again [s]; doubles each time, up to half a minute."""

PublishRaw = Callable[[str, bytes], None]
"""Publishes a message on a topic."""
SetRelay = Callable[[Relay], Awaitable[None]]
"""Sends the level of the board's relay. Raises UserError when it does not take it."""

log = structlog.get_logger(__name__)


class Job(NamedTuple):
    """One thing to be done by a hook."""

    alarm: Alarm
    state: Literal["raised", "cleared"]


class AlarmHooks:
    """All hooks of a pack; a context manager.

    Args:
        hooks: Configured hooks.
        device: Name of the pack.
        say: Publishes a message; None: there is no broker.
        switch: Switches the relay; None: the source has none.

    Raises:
        UserError: A hook needs something that is missing.
    """

    def __init__(
        self, hooks: Sequence[AlarmHook], device: str, say: PublishRaw | None, switch: SetRelay | None
    ) -> None:
        self._hooks = [_made(i, hook, device, say, switch) for i, hook in enumerate(hooks)]
        self._tasks: list[asyncio.Task[None]] = []

    @property
    def health(self) -> HookHealth | None:
        """Successes and failures since start; None without hooks."""
        if not self._hooks:
            return None
        return HookHealth(
            done=sum(hook.done for hook in self._hooks),
            failures=sum(hook.failures for hook in self._hooks),
            failing=[f"{hook.what}: {hook.trouble}" for hook in self._hooks if hook.trouble],
        )

    def on_alarm_change(self, change: Change) -> None:
        """Pass a change of an alarm to its hooks; returns at once."""
        for hook in self._hooks:
            if hook.covers(change.alarm.name):
                hook.on_alarm_change(change)

    def restore_active(self, alarms: Sequence[Alarm]) -> None:
        """Take over alarms of an earlier run.

        Their jobs have been done, but the relay must be as it was. If a hook had failed, all jobs are done again: one that
        could not be done would be lost.
        """
        raised = {alarm.name for alarm in alarms if _counts_as_raised(alarm)}
        if "hook_failed" not in raised:
            for hook in self._hooks:
                hook.restore_active(raised)
            return
        for hook in self._hooks:
            hook.restore_active({"hook_failed"})
        for alarm in alarms:
            self.on_alarm_change(Change(0.0, alarm))

    async def __aenter__(self) -> Self:
        """Start."""
        self._tasks = [asyncio.create_task(hook.supervise(), name="alarm hook") for hook in self._hooks]
        return self

    async def __aexit__(self, *_error: object) -> None:
        """Let running programs end within ``CLOSE_S``."""
        for hook in self._hooks:
            hook.close()
        if self._tasks:
            _, late = await asyncio.wait(self._tasks, timeout=CLOSE_S)
            for task in late:
                task.cancel()
            await asyncio.gather(*late, return_exceptions=True)


class _Hook:
    """One hook, which does its jobs one after the other.

    Attributes:
        done: Jobs done since start.
        failures: Failed attempts since start.
        trouble: Reason why the last attempt failed; empty if it did not.
    """

    def __init__(self, hook: AlarmHook, device: str) -> None:
        self._hook, self._device = hook, device
        self.done, self.failures, self.trouble = 0, 0, ""
        self._raised: set[str] = set()
        self._waiting: deque[Job] = deque(maxlen=WAITING)
        self._wake = asyncio.Event()
        self._closing = False

    @property
    def what(self) -> str:
        """Short description. A program's arguments are left out, since they may hold secrets."""
        raise NotImplementedError

    def covers(self, name: str) -> bool:
        """Return whether an alarm is one of this hook's. ``hook_failed`` must be listed."""
        return name in self._hook.alarms if self._hook.alarms else name != "hook_failed"

    def on_alarm_change(self, change: Change) -> None:
        """Queue the job that follows from a change."""
        job = self._job(change)
        if job is None or job.state not in self._hook.on:
            return
        if len(self._waiting) == WAITING:
            log.warning("an alarm hook is behind: its oldest alarm is left out", hook=self.what)
        self._waiting.append(job)

    def restore_active(self, raised: Collection[str]) -> None:
        """Take over alarms of an earlier run."""
        self._raised = {name for name in raised if self.covers(name)}

    def close(self) -> None:
        """End: no more alarms follow."""
        self._closing = True
        self._wake.set()

    async def supervise(self) -> None:
        """Do all jobs until it is closed. An internal error must not end the hook; it is logged and counted."""
        while True:
            try:
                return await self.work()
            except Exception as error:
                self.failures, self.trouble = self.failures + 1, f"internal error: {error!r}"
                log.exception("alarm hook: internal error", hook=self.what)
                await asyncio.sleep(FIRST_RETRY_S)

    async def work(self) -> None:
        """Do all jobs until it is closed."""
        while not self._closing or self._waiting:
            await self._wake.wait()
            if not self._closing:
                self._wake.clear()
            while self._waiting:
                job = self._waiting.popleft()
                if self._hook.dry_run:
                    log.warning("alarm hook, dry run", would=self.what, alarm=job.alarm.name, state=job.state)
                else:
                    await self._do(job)

    async def _do(self, job: Job) -> None:
        raise NotImplementedError

    def _job(self, change: Change) -> Job | None:
        """Note a change. Return the job that follows, if one does."""
        alarm = change.alarm
        is_raised = _counts_as_raised(alarm)
        if is_raised == (alarm.name in self._raised):
            return None
        self._raised ^= {alarm.name}
        self._wake.set()
        return Job(alarm, "raised" if is_raised else "cleared")

    def _is_due(self, job: Job) -> bool:
        """Return whether a job must still be done: the hook is open and the alarm's state has not changed."""
        return not self._closing and (job.alarm.name in self._raised) == (job.state == "raised")

    def _succeed(self) -> None:
        self.done += 1
        self.trouble = ""

    def _fail(self, job: Job, trouble: str) -> None:
        """Count a failure. A failed job for ``hook_failed`` does not raise ``hook_failed`` again: that would never end."""
        self.failures += 1
        if job.alarm.name != "hook_failed":
            self.trouble = trouble


def _counts_as_raised(alarm: Alarm) -> bool:
    """Return true for a raised alarm, and for a critical one that cannot be watched: that is the safe side."""
    return alarm.active or (alarm.severity == "critical" and not alarm.watched)


class _CommandHook(_Hook):
    """Runs a program: the alarm as JSON on its standard input, its fields in the environment."""

    @property
    def what(self) -> str:
        """The program."""
        return f"run {(self._hook.run or ('',))[0]}"

    async def _do(self, job: Job) -> None:
        """Run the program; one that cannot be started is tried again until it starts or the alarm's state changes."""
        pauses = Backoff(FIRST_RETRY_S)
        while not await self._run(job):
            await self._pause(job, pauses.next_s())
            if not self._is_due(job):
                log.warning("alarm hook: the program was never started", hook=self.what, alarm=job.alarm.name)
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
        values = _values(job, self._device)
        text, timeout_s = values.pop("json").encode(), self._hook.timeout_s
        variables = environment(self._hook.pass_environment, values)
        try:
            code = await run(self._hook.run or (), text, variables, timeout_s)
        except StartError as error:
            self._fail(job, f"cannot be started: {error}")
            log.warning("alarm hook: the program cannot be started", hook=self.what, error=str(error))
            return False
        if code is None:
            self._fail(job, f"took longer than {timeout_s:g} s")
            log.warning("alarm hook: the program takes too long and is killed", hook=self.what)
        elif code:
            self._fail(job, f"exit code {code}")
            log.warning("alarm hook: the program has failed", hook=self.what, exit_code=code)
        else:
            self._succeed()
        return True


class _PublishHook(_Hook):
    """Publishes a message."""

    def __init__(self, hook: AlarmHook, device: str, topic: str, say: PublishRaw) -> None:
        super().__init__(hook, device)
        self._topic, self._say = topic, say

    @property
    def what(self) -> str:
        """The topic."""
        return f"publish on {self._topic}"

    async def _do(self, job: Job) -> None:
        self._say(self._topic, Template(self._hook.payload).substitute(_values(job, self._device)).encode())
        self._succeed()


class _RelayHook(_Hook):
    """Hook that keeps the board's relay at its level by repeated commands, because a reset releases it."""

    def __init__(self, hook: AlarmHook, device: str, switch: SetRelay) -> None:
        super().__init__(hook, device)
        self._switch = switch

    @property
    def what(self) -> str:
        """The level."""
        return f"relay pin {'high' if self._wanted.high else 'low'}"

    @property
    def _wanted(self) -> Relay:
        high = (self._hook.relay == "high") == bool(self._raised)
        silent = self._hook.level_when_silent
        kept = silent == "keep"
        return Relay(high, None if kept else silent == "high", 0 if kept else self._hook.silent_s)

    def on_alarm_change(self, change: Change) -> None:
        """Follow the alarms regardless of the hook's ``on``.

        The level depends on whether one of them counts as raised.
        """
        before = self._wanted
        job = self._job(change)
        if job is not None and self._wanted != before:
            log.warning("relay", dry_run=self._hook.dry_run, hook=self.what, alarm=job.alarm.name, state=job.state)

    async def work(self) -> None:
        """Set the level again and again until it is closed."""
        while not self._hook.dry_run and not self._closing:
            self._wake.clear()
            try:
                await self._switch(self._wanted)
                if self.trouble:
                    log.info("the board takes its relay's level again", hook=self.what)
                self.trouble = ""
            except UserError as error:
                if str(error) != self.trouble:
                    log.warning("the board does not take its relay's level", hook=self.what, reason=str(error))
                self.failures, self.trouble = self.failures + 1, str(error)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(RETRY_S if self.trouble else RELAY_S):
                    await self._wake.wait()


def unusable(settings: Settings) -> list[str]:
    """One line for each hook without its program, and for each relay without a configured level for a silent service.

    Raises:
        UserError: A hook needs a broker or a relay that is not there.
    """
    hooks = settings.alarms.hook
    AlarmHooks(
        hooks, settings.pack.name, (lambda *_: None) if settings.mqtt else None, relay_of(settings, _switch_nothing)
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


def relay_of(settings: Settings, switch: SetRelay | None) -> SetRelay | None:
    """``switch`` where the source has a relay: no device but the firmware's board has a pin for one."""
    return switch if settings.sensor.protocol == "binary" else None


async def _switch_nothing(_: Relay) -> None:
    """Do nothing, for a pack without a board."""


def _made(i: int, hook: AlarmHook, device: str, say: PublishRaw | None, switch: SetRelay | None) -> _Hook:
    if hook.topic:
        if say is None:
            raise UserError(f"alarms.hook.{i}.topic = {hook.topic}: there is no broker; add the section [mqtt]")
        return _PublishHook(hook, device, hook.topic, say)
    if hook.relay:
        if switch is None:
            raise UserError(
                f"alarms.hook.{i}.relay: only the board of [sensor] with protocol = 'binary' has a relay pin"
            )
        return _RelayHook(hook, device, switch)
    return _CommandHook(hook, device)


def _values(job: Job, device: str) -> dict[str, str]:
    """Fields for a program or a payload; empty where there is no value."""
    alarm = job.alarm
    fields = {name: getattr(alarm, name) for name in ("name", "severity", "since", "value", "limit", "unit")}
    values = {name: "" if value is None else str(value) for name, value in fields.items()}
    text = alarm.text or alarm.unwatched_reason or ""
    return values | {"text": text, "device": device, "state": job.state, "json": alarm.json_bytes.decode()}
