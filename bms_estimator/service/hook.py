"""Base class of the hooks of a pack."""

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Iterable

import structlog

from bms_estimator.model.payloads.snapshot import Alarm
from bms_estimator.settings.alarms import AlarmHook

ERROR_PAUSE_S = 0.5
"""Pause of a hook after an internal error [s], so that a persistent one does not fill the log."""

log = structlog.get_logger(__name__)


class Hook(ABC):
    """One hook.

    Attributes:
        settings: Settings of the hook.
        done: Number of completed jobs since start.
        failures: Number of failed attempts since start.
        relay_resets: Number of resets of the board that undid a relay command, since start.
        error: Reason why the last attempt failed; empty after a success.
        has_evaluated: True once enough samples have arrived to raise all due alarms.
    """

    def __init__(self, settings: AlarmHook) -> None:
        self.settings = settings
        self.done, self.failures, self.relay_resets, self.error = 0, 0, 0, ""
        self._raised: dict[str, Alarm] = {}  # alarms of this hook that count as raised, by name
        self.has_evaluated = False
        self._wake = asyncio.Event()
        self._closing = False

    @property
    @abstractmethod
    def description(self) -> str:
        """Short description, without the arguments of a program, which may hold secrets."""

    @property
    def is_busy(self) -> bool:
        """True while a job is running or waiting."""
        return False

    def applies_to(self, name: str) -> bool:
        """Return True if the hook is for this alarm: ``alarm_state_lost`` always, ``hook_failed`` only if listed."""
        if name == "alarm_state_lost":
            return True
        return name in self.settings.alarms if self.settings.alarms else name != "hook_failed"

    def on_alarm_change(self, alarm: Alarm) -> None:
        """Record the new state of an alarm of this hook, and act if it was raised or cleared."""
        was_raised, is_raised = alarm.name in self._raised, counts_as_raised(alarm)
        if is_raised:
            self._raised[alarm.name] = alarm
        else:
            self._raised.pop(alarm.name, None)
        if is_raised != was_raised:
            self._on_transition(alarm)
            self._wake.set()

    @abstractmethod
    def _on_transition(self, alarm: Alarm) -> None:
        """Handle an alarm that was raised or cleared."""

    def restore_active(self, alarms: Iterable[Alarm]) -> None:
        """Restore raised alarms of an earlier run, on which the hook has acted."""
        self._raised.update({alarm.name: alarm for alarm in alarms if self.applies_to(alarm.name)})

    def close(self) -> None:
        """Request that ``run`` returns after the waiting jobs."""
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
                await asyncio.sleep(ERROR_PAUSE_S)

    @abstractmethod
    async def _run_jobs(self) -> None:
        """Run jobs until the hook is closed."""


def counts_as_raised(alarm: Alarm) -> bool:
    """Return True for a raised alarm, and for a critical alarm that cannot be watched and might have to be raised."""
    return alarm.active or (alarm.severity == "critical" and not alarm.watched)
