"""What is done when an alarm is raised or ends: each hook has a task of its own, and nothing waits for it."""

import asyncio
import contextlib
import os
import shutil
import signal
import uuid
from collections import deque
from collections.abc import Awaitable, Callable, Collection, Sequence
from pathlib import Path
from string import Template
from typing import Any, Self

import structlog

from bms_estimator.model.alarm_settings import AlarmHook
from bms_estimator.model.errors import UserError
from bms_estimator.model.estimate import Alarm
from bms_estimator.model.settings import Settings
from bms_estimator.sinks.pauses import Pauses
from bms_estimator.snapshot.alarms import Change
from bms_estimator.sources.protocol import Relay

WAITING = 100
"""So many alarms wait for a program that takes its time; then the oldest goes."""
RELAY_S, RETRY_S = 2.0, 0.5
"""So often the board is told its relay's level, at least [s]: it may have been reset, or replaced; and once it did not take it."""
CLOSE_S = 2.0
"""At the end what is under way may take so long [s]."""
FIRST_RETRY_S = 0.5
"""First pause before a program that could not be started is tried again [s]; doubles each time, up to half a minute."""
PASSED = ("PATH", "HOME", "USER", "LOGNAME", "SHELL", "LANG", "LC_ALL", "TZ", "TMPDIR")
"""Environment variables of the service that every program gets. Others may hold secrets of the service."""
MARK = "BMS_HOOK_RUN"
"""Environment variable with an identifier of one run, by which its descendants are found."""

Say = Callable[[str, bytes], None]
"""Publishes a message on a topic."""
Switch = Callable[[Relay], Awaitable[None]]
"""Tells the board its relay's level. Raises UserError when it does not take it."""

log = structlog.get_logger(__name__)


class Hooks:
    """All hooks of a pack; a context manager.

    Args:
        hooks: What is done, and when.
        device: Name of the pack.
        say: Publishes; None: there is no broker.
        switch: Switches the relay; None: the source has none.

    Raises:
        UserError: A hook needs what is not there.
    """

    def __init__(self, hooks: Sequence[AlarmHook], device: str, say: Say | None, switch: Switch | None) -> None:
        self._hooks = [_made(i, hook, device, say, switch) for i, hook in enumerate(hooks)]
        self._tasks: list[asyncio.Task[None]] = []

    def tell(self, change: Change) -> None:
        """An alarm was raised or has ended; returns at once."""
        for hook in self._hooks:
            hook.tell(change.alarm)

    def begin(self, active: Collection[str]) -> None:
        """These alarms are active from a run before: what they are for has been done, but the relay must be as it was."""
        for hook in self._hooks:
            hook.begin(active)

    async def __aenter__(self) -> Self:
        """Start."""
        self._tasks = [asyncio.create_task(hook.work(), name="alarm hook") for hook in self._hooks]
        return self

    async def __aexit__(self, *_error: object) -> None:
        """Let what is under way end, within ``CLOSE_S``."""
        for hook in self._hooks:
            hook.close()
        if self._tasks:
            done, late = await asyncio.wait(self._tasks, timeout=CLOSE_S)
            for task in late:
                task.cancel()
            await asyncio.gather(*late, return_exceptions=True)
            for task in done:
                task.result()  # only a fault of ours ends one: let it be seen


class _Hook:
    """What one does with alarms, one after the other."""

    def __init__(self, hook: AlarmHook, device: str) -> None:
        self._hook, self._device = hook, device
        self._waiting: deque[Alarm] = deque(maxlen=WAITING)
        self._wake = asyncio.Event()
        self._closing = False

    def tell(self, alarm: Alarm) -> None:
        """Have it done."""
        if (not self._hook.alarms or alarm.name in self._hook.alarms) and _state(alarm) in self._hook.on:
            if len(self._waiting) == WAITING:
                log.warning("an alarm hook is behind: its oldest alarm is left out", hook=self._what)
            self._waiting.append(alarm)
            self._wake.set()

    def begin(self, active: Collection[str]) -> None:
        """These were active before the start."""

    def close(self) -> None:
        """No more will come."""
        self._closing = True
        self._wake.set()

    async def work(self) -> None:
        """Until it is closed, and nothing waits any more."""
        while not self._closing or self._waiting:
            await self._wake.wait()
            if not self._closing:
                self._wake.clear()
            while self._waiting:
                alarm = self._waiting.popleft()
                if self._hook.dry_run:
                    log.warning("alarm hook, dry run", would=self._what, alarm=alarm.name, state=_state(alarm))
                else:
                    await self._do(alarm)

    async def _do(self, alarm: Alarm) -> None:
        raise NotImplementedError

    @property
    def _what(self) -> str:
        raise NotImplementedError


class _Program(_Hook):
    """Runs a program: the alarm as JSON on its standard input, its fields in the environment."""

    def __init__(self, hook: AlarmHook, device: str) -> None:
        super().__init__(hook, device)
        self._states: dict[str, bool] = {}

    @property
    def _what(self) -> str:
        return f"run {' '.join(self._hook.run or ())}"

    def tell(self, alarm: Alarm) -> None:
        """Note the alarm's state, which ends the retries for another one, and have the program run."""
        self._states[alarm.name] = alarm.active
        self._wake.set()
        super().tell(alarm)

    async def _do(self, alarm: Alarm) -> None:
        """Run the program; one that cannot be started is tried again until it starts or the alarm's state changes."""
        pauses = Pauses(FIRST_RETRY_S)
        while not await self._run(alarm):
            if not await self._retry(alarm, pauses.next_s()):
                return

    async def _retry(self, alarm: Alarm, pause_s: float) -> bool:
        """Wait before another attempt. Return False once the alarm's state has changed or the hook is closed."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(pause_s):
                while not self._closing and self._states[alarm.name] == alarm.active:
                    self._wake.clear()
                    await self._wake.wait()
        return not self._closing and self._states[alarm.name] == alarm.active

    async def _run(self, alarm: Alarm) -> bool:
        """Run the program once. Return False if it could not be started."""
        values, run = _values(alarm, self._device), uuid.uuid4().hex
        environment = {name: os.environ[name] for name in (*PASSED, *self._hook.pass_environment) if name in os.environ}
        environment |= {f"BMS_{name.upper()}": value for name, value in values.items() if name != "json"}
        try:
            process = await asyncio.create_subprocess_exec(
                *(self._hook.run or ()),
                stdin=asyncio.subprocess.PIPE,
                stdout=asyncio.subprocess.DEVNULL,
                stderr=asyncio.subprocess.DEVNULL,
                env=environment | {MARK: run},
                start_new_session=True,
            )
        except (OSError, ValueError) as error:
            log.warning("alarm hook: the program cannot be started", hook=self._what, error=str(error))
            return False
        try:
            async with asyncio.timeout(self._hook.timeout_s):
                await process.communicate(values["json"].encode())
            if process.returncode:
                log.warning("alarm hook: the program has failed", hook=self._what, exit_code=process.returncode)
        except TimeoutError:
            log.warning("alarm hook: the program takes too long and is killed", hook=self._what)
        finally:
            if process.returncode is None:
                await _kill(process, run)
        return True


class _Publication(_Hook):
    """Publishes a message."""

    def __init__(self, hook: AlarmHook, device: str, topic: str, say: Say) -> None:
        super().__init__(hook, device)
        self._topic, self._say = topic, say

    @property
    def _what(self) -> str:
        return f"publish on {self._topic}"

    async def _do(self, alarm: Alarm) -> None:
        self._say(self._topic, Template(self._hook.payload).substitute(_values(alarm, self._device)).encode())


class _Switched(_Hook):
    """Keeps the board's relay at its level: told again and again, since a reset releases it."""

    def __init__(self, hook: AlarmHook, device: str, switch: Switch) -> None:
        super().__init__(hook, device)
        self._switch = switch
        self._active: set[str] = set()
        self._trouble = ""

    @property
    def _what(self) -> str:
        return f"relay pin {'high' if self._wanted.high else 'low'}"

    @property
    def _wanted(self) -> Relay:
        high = (self._hook.relay == "high") == bool(self._active)
        silent = self._hook.level_when_silent
        kept = silent == "keep"
        return Relay(high, None if kept else silent == "high", 0 if kept else self._hook.silent_s)

    def tell(self, alarm: Alarm) -> None:
        """Whatever the hook is ``on``: the level follows whether one of the alarms is active."""
        if self._hook.alarms and alarm.name not in self._hook.alarms:
            return
        before = bool(self._active)
        (self._active.add if alarm.active else self._active.discard)(alarm.name)
        if bool(self._active) != before:
            log.warning("relay", dry_run=self._hook.dry_run, hook=self._what, alarm=alarm.name, state=_state(alarm))
            self._wake.set()

    def begin(self, active: Collection[str]) -> None:
        """The relay is to be as it was."""
        self._active = {name for name in active if not self._hook.alarms or name in self._hook.alarms}

    async def work(self) -> None:
        """Until it is closed."""
        while not self._hook.dry_run and not self._closing:
            self._wake.clear()
            try:
                await self._switch(self._wanted)
                if self._trouble:
                    log.info("the board takes its relay's level again", hook=self._what)
                self._trouble = ""
            except UserError as error:
                if str(error) != self._trouble:
                    log.warning("the board does not take its relay's level", hook=self._what, reason=str(error))
                self._trouble = str(error)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(RETRY_S if self._trouble else RELAY_S):
                    await self._wake.wait()


def unusable(settings: Settings) -> list[str]:
    """One line for each hook whose program is not there, and for each relay without a stated level for a silent service.

    Raises:
        UserError: A hook needs a broker or a relay that is not there.
    """
    hooks = settings.alarms.hook
    Hooks(hooks, settings.pack.name, (lambda *_: None) if settings.mqtt else None, relay_of(settings, _switch_nothing))
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


def relay_of(settings: Settings, switch: Switch | None) -> Switch | None:
    """``switch`` where the source has a relay: no device but the firmware's board has a pin for one."""
    return switch if settings.sensor.protocol == "binary" else None


async def _switch_nothing(_: Relay) -> None:
    """Of no board."""


def _made(i: int, hook: AlarmHook, device: str, say: Say | None, switch: Switch | None) -> _Hook:
    if hook.topic:
        if say is None:
            raise UserError(f"alarms.hook.{i}.topic = {hook.topic}: there is no broker; add the section [mqtt]")
        return _Publication(hook, device, hook.topic, say)
    if hook.relay:
        if switch is None:
            raise UserError(
                f"alarms.hook.{i}.relay: only the board of [sensor] with protocol = 'binary' has a relay pin"
            )
        return _Switched(hook, device, switch)
    return _Program(hook, device)


def _state(alarm: Alarm) -> Any:
    return "raised" if alarm.active else "cleared"


def _values(alarm: Alarm, device: str) -> dict[str, str]:
    """What a program or a payload is told; empty where there is nothing."""
    told = {name: getattr(alarm, name) for name in ("name", "severity", "since", "value", "limit", "unit", "text")}
    values = {name: "" if value is None else str(value) for name, value in told.items()}
    return values | {"device": device, "state": _state(alarm), "json": alarm.model_dump_json()}


async def _kill(process: asyncio.subprocess.Process, run: str) -> None:
    """Kill the program's process group, and descendants that left it."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    _kill_descendants(f"{MARK}={run}".encode())
    await process.wait()


def _kill_descendants(mark: bytes) -> None:
    """Kill each process that has ``mark`` in its environment."""
    for environment in Path("/proc").glob("[0-9]*/environ"):
        with contextlib.suppress(OSError):
            if mark in environment.read_bytes().split(b"\0"):
                os.kill(int(environment.parent.name), signal.SIGKILL)
