"""Alarm hooks: actions when an alarm is raised or ends. Each hook runs in its own task and delays nothing else."""

import asyncio
import hashlib
from collections.abc import Callable, Collection, Sequence
from typing import Self

from bms_estimator.model.clock import since_boot
from bms_estimator.model.payloads.health import HookHealth
from bms_estimator.model.payloads.snapshot import Alarm
from bms_estimator.service.hook import Hook, counts_as_raised
from bms_estimator.service.hook_check import require_output
from bms_estimator.service.job_hook import CommandHook, PublishHook, PublishRaw
from bms_estimator.service.relay_hook import RelayBoard, RelayHook
from bms_estimator.settings.alarms import AlarmHook
from bms_estimator.telemetry.alarms.definitions import Change

CLOSE_TIMEOUT_S = 2.0
"""Timeout of running hooks at shutdown [s]."""


class AlarmHooks:
    """All hooks of a pack; a context manager.

    Args:
        hooks: Configured hooks.
        device: Name of the pack.
        publish: Publishes a message; None without a broker.
        board: Board with a relay pin; None without one.
        clock: Time since boot of the host [s].

    Attributes:
        check_watching: ``AlarmMonitor.check_silence``, which returns True once enough samples have arrived to raise all due
            alarms. A relay hook calls it before each command.

    Raises:
        UserError: A hook needs something that is missing.
    """

    def __init__(
        self,
        hooks: Sequence[AlarmHook],
        device: str,
        publish: PublishRaw | None,
        board: RelayBoard | None,
        clock: Callable[[], float] = since_boot,
    ) -> None:
        self.check_watching: Callable[[], bool] = lambda: True
        self._hooks: list[Hook] = []
        for i, hook in enumerate(hooks):
            require_output(i, hook, broker=publish is not None, relay=board is not None)
            if hook.topic and publish:
                self._hooks.append(PublishHook(hook, device, hook.topic, publish))
            elif hook.relay and board:
                self._hooks.append(RelayHook(hook, board, clock, lambda: self.check_watching()))  # noqa: PLW0108 - set later
            else:
                self._hooks.append(CommandHook(hook, device))
        self._tasks: list[asyncio.Task[None]] = []

    @property
    def health(self) -> HookHealth | None:
        """Successes and failures since start; None without hooks."""
        if not self._hooks:
            return None
        return HookHealth(
            done=sum(hook.done for hook in self._hooks),
            failures=sum(hook.failures for hook in self._hooks),
            relay_resets=sum(hook.relay_resets for hook in self._hooks),
            failing=[f"{hook.description}: {hook.error}" for hook in self._hooks if hook.error],
        )

    def on_alarm_change(self, change: Change) -> None:
        """Pass a change of an alarm to its hooks; returns at once."""
        for hook in self._hooks:
            if hook.applies_to(change.alarm.name):
                hook.on_alarm_change(change.alarm)

    def stop_watching(self) -> None:
        """Stop setting relays to their level without an alarm until alarms are evaluated again."""
        for hook in self._hooks:
            hook.has_evaluated = False
        self.check_watching = lambda: False

    @property
    def finished_hashes(self) -> list[str]:
        """Hashes of the hooks without unfinished or failed jobs."""
        return [_hash(hook.settings) for hook in self._hooks if not (hook.is_busy or hook.error)]

    def restore_active(
        self, alarms: Sequence[Alarm], finished: Collection[str] | None = None, *, crashed: bool = False
    ) -> None:
        """Restore the alarms of an earlier run.

        Jobs of these alarms are not repeated, but the relay is set to its level. A hook that is new, or whose jobs were not
        finished, runs its jobs. If ``hook_failed`` was raised, all hooks repeat their jobs, so that the failed one is not lost.

        Args:
            alarms: All alarms.
            finished: ``finished_hashes`` at the end of the earlier run; None: no hook counts as new.
            crashed: True if the earlier run crashed or was killed, perhaps with unfinished jobs. All jobs are repeated.
        """
        raised = [alarm for alarm in alarms if counts_as_raised(alarm)]
        failed = [alarm for alarm in raised if alarm.name == "hook_failed"]
        for hook in self._hooks:
            is_unfinished = crashed or (finished is not None and _hash(hook.settings) not in finished)
            if failed or is_unfinished:
                for alarm in raised:  # a finished hook does not announce hook_failed again
                    if (is_unfinished or alarm not in failed) and hook.applies_to(alarm.name):
                        hook.on_alarm_change(alarm)
                hook.restore_active(failed)
            else:
                hook.restore_active(raised)

    async def __aenter__(self) -> Self:
        """Start a task for each hook."""
        self._tasks = [asyncio.create_task(hook.run(), name="alarm hook") for hook in self._hooks]
        return self

    async def __aexit__(self, *_error: object) -> None:
        """Wait up to ``CLOSE_TIMEOUT_S`` for running programs."""
        for hook in self._hooks:
            hook.close()
        if self._tasks:
            _, late = await asyncio.wait(self._tasks, timeout=CLOSE_TIMEOUT_S)
            for task in late:
                task.cancel()
            await asyncio.gather(*late, return_exceptions=True)


def _hash(hook: AlarmHook) -> str:
    """Return a hash of the settings that differ from the defaults, so that a later version with more settings returns the same.

    The settings are hashed because a hook's arguments may hold secrets.
    """
    return hashlib.sha256(hook.model_dump_json(exclude_defaults=True).encode()).hexdigest()[:16]
