"""Hook that switches the relay of the sensor board."""

import asyncio
import contextlib
from collections.abc import Callable, Iterable
from typing import Protocol

import structlog

from bms_estimator.model.errors import UserError
from bms_estimator.model.payloads.snapshot import Alarm
from bms_estimator.protocols.base.relay import Relay
from bms_estimator.service.hook import Hook
from bms_estimator.settings.alarms import AlarmHook

COMMAND_INTERVAL_S = 2.0
"""Interval between two relay commands [s]. A command holds only until the board is reset or replaced."""
COMMAND_RETRY_S = 0.5
"""Interval between attempts after a failed relay command [s]."""
RESET_POLL_S = 0.1
"""Interval between two checks for a reset of the board [s]."""
FIRST_HOLD_S = 30.0
"""First hold time, and time without a reset after which the hook has no error [s]."""
MAX_HOLD_S = 600.0
"""Maximum hold time [s]. It limits a relay whose load resets the board to six switchings an hour."""
QUIET_S = 3600.0
"""Time without a reset after which the next reset counts as the first one [s]."""

log = structlog.get_logger(__name__)


class RelayHold:
    """Hold of a relay: time after a reset of the board in which the pin is not set high. Each further reset doubles it.

    If low is the safe level, the first reset starts a hold. Otherwise the pin's low level after a reset is the unsafe one, and
    the first reset starts no hold.

    Args:
        low_is_safe: True if the pin is low while an alarm is raised.

    Attributes:
        boots: Number of boots of the board at the last check.
        resets: Number of resets without a quiet time between them.
        hold_s: Hold time after the last reset [s].
    """

    def __init__(self, *, low_is_safe: bool) -> None:
        self._low_is_safe = low_is_safe
        self.boots, self.resets, self.hold_s = 0, 0, 0.0
        self._reset_s = self._hold_end_s = self._proven_s = -QUIET_S

    def check(self, boots: int, now_s: float) -> int:
        """Start a hold if the board was reset since the last check. Return the number of these resets.

        Args:
            boots: Number of boots of the board.
            now_s: Time since boot of the host [s].
        """
        resets, self.boots = boots - self.boots, boots
        if resets:
            self._start_hold(resets, now_s)
            self._proven_s = now_s + max(self.hold_s, FIRST_HOLD_S)
        return resets

    def resume(self, now_s: float) -> None:
        """Start a hold as after a reset, because the relay may have failed before the restart of the service."""
        self._start_hold(1, now_s)

    def end(self) -> None:
        """End the hold, because an alarm was raised. If low is the safe level, the hold remains: it permits the low level."""
        if not self._low_is_safe:
            self._hold_end_s = -QUIET_S

    def level(self, *, high: bool, now_s: float) -> bool | None:
        """Return the level to set, given the level for the present alarms; None: send no command."""
        if not high or now_s >= self._hold_end_s:
            return high
        return False if self._low_is_safe else None

    def is_proven(self, now_s: float) -> bool:
        """Return True if the commands after the last reset have held long enough."""
        return now_s >= self._proven_s

    def _start_hold(self, resets: int, now_s: float) -> None:
        if now_s - self._reset_s >= QUIET_S:
            self.resets = 0
        self.resets += resets
        doublings = self.resets - (1 if self._low_is_safe else 2)
        self.hold_s = min(FIRST_HOLD_S * 2.0 ** min(doublings, 10), MAX_HOLD_S) if doublings >= 0 else 0.0
        self._reset_s, self._hold_end_s = now_s, now_s + self.hold_s


class RelayBoard(Protocol):
    """Board with a relay pin."""

    @property
    def boots(self) -> int:
        """Number of resets and exchanges of the board since start."""

    async def relay(self, relay: Relay, boots: int) -> None:
        """Set the relay pin.

        Args:
            relay: Level of the pin.
            boots: Value of ``boots`` for which the command is meant. After another reset it is not sent.

        Raises:
            UserError: The board does not confirm the level, or was reset.
        """


class RelayHook(Hook):
    """Hook that keeps the board's relay at its level by repeated commands.

    Args:
        settings: Settings of the hook.
        board: The board.
        clock: Time since boot of the host [s].
        check_watching: Evaluates the time since the last sample, and returns True once enough samples have arrived to raise
            all due alarms. Before that, the level without an alarm is not sent, so that a restart or a crash loop connects
            no load.
    """

    def __init__(
        self, settings: AlarmHook, board: RelayBoard, clock: Callable[[], float], check_watching: Callable[[], bool]
    ) -> None:
        super().__init__(settings)
        self._board, self._clock, self._check_watching = board, clock, check_watching
        self._hold = RelayHold(low_is_safe=settings.relay == "low")

    @property
    def description(self) -> str:
        """Description with the present level of the relay pin."""
        return f"relay pin {'high' if self._wants_high else 'low'}"

    @property
    def _wants_high(self) -> bool:
        """True if the pin is to be high: its level in ``relay`` while an alarm is raised, otherwise the opposite level."""
        return (self.settings.relay == "high") == bool(self._raised)

    def _on_transition(self, alarm: Alarm) -> None:
        """Log a change of the level. The setting ``on`` does not apply to a relay."""
        if self._raised.keys() - {alarm.name}:  # another alarm is raised, so that the level does not change
            return
        state = "raised" if self._raised else "cleared"
        log.warning("relay", dry_run=self.settings.dry_run, hook=self.description, alarm=alarm.name, state=state)
        if self._raised:
            self._hold.end()

    def restore_active(self, alarms: Iterable[Alarm]) -> None:
        """Restore raised alarms of an earlier run. If a hook had failed, the board may be in a reset loop."""
        alarms = list(alarms)
        super().restore_active(alarms)
        if any(alarm.name == "hook_failed" for alarm in alarms):
            self._hold.resume(self._clock())

    async def _run_jobs(self) -> None:
        """Send the level repeatedly until the hook is closed."""
        while not self.settings.dry_run and not self._closing:
            self._wake.clear()
            self._check_resets()
            command_error = await self._send_level()
            self._check_resets()  # a reset after the command undoes it
            self._set_error(self._reset_error() or command_error)
            await self._wait(COMMAND_RETRY_S if command_error else COMMAND_INTERVAL_S)

    def _check_resets(self) -> None:
        resets = self._hold.check(self._board.boots, self._clock())
        self.relay_resets += resets
        self.failures += resets
        if resets:
            self._set_error(self._reset_error())

    async def _send_level(self) -> str:
        """Send the level that is allowed now. Return the reason why the board does not confirm it; empty if it does."""
        self.has_evaluated = self._check_watching() or self.has_evaluated  # first, because it may raise alarms
        if not (self._raised or self.has_evaluated):
            return ""
        level = self._hold.level(high=self._wants_high, now_s=self._clock())
        if level is None:
            return ""
        try:
            await self._board.relay(self._command(high=level), self._hold.boots)
        except UserError as error:
            self.failures += 1
            return str(error)
        return ""

    def _reset_error(self) -> str:
        """Return the error after a reset until later commands have held long enough; otherwise an empty text."""
        if self._hold.is_proven(self._clock()):
            return ""
        return (
            "the board was reset after a relay command, and a reset sets the pin low; check the board's supply and its "
            f"cable; the pin is not set high for {self._hold.hold_s:g} s"
        )

    def _set_error(self, error: str) -> None:
        if error and error != self.error:
            log.warning("the board does not hold a relay command", hook=self.description, reason=error)
        elif self.error and not error:
            log.info("the board holds relay commands again", hook=self.description)
        self.error = error

    def _command(self, *, high: bool) -> Relay:
        """Return the command with a level, and with the level for a silent service."""
        if self.settings.level_when_silent == "keep":
            return Relay(high, high_when_silent=None)
        high_when_silent = self.settings.level_when_silent == "high"
        return Relay(high, high_when_silent=high_when_silent, silent_s=self.settings.silent_s)

    async def _wait(self, pause_s: float) -> None:
        """Wait until the next command is due, an alarm changes or the board was reset."""
        for _ in range(round(pause_s / RESET_POLL_S)):
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(RESET_POLL_S):
                    await self._wake.wait()
                    return
            if self._board.boots != self._hold.boots:
                return
