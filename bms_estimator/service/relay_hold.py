"""Waiting times before the relay is driven again after resets of the board.

The relay pin is low after each reset. A board in a reset loop would therefore switch the relay with each command.
"""

FIRST_HOLD_S = 30.0
"""First waiting time, and time for which a command must hold after a reset until the hook has no error [s]."""
MAX_HOLD_S = 600.0
"""Longest waiting time [s]. It limits a relay whose load resets the board to six switchings an hour."""
QUIET_S = 3600.0
"""Time without a reset after which the waiting times start again with the first one [s]."""


class RelayHold:
    """Waiting times of one relay. Each further reset doubles the waiting time.

    If low is the safe level, the first reset already causes a waiting time. Otherwise the pin's low level after a reset is
    the unsafe one, and the first reset causes no waiting time.

    Args:
        low_is_safe: True if the pin is low while an alarm is raised.

    Attributes:
        boots: Number of boots of the board at the last check.
        resets: Number of resets without a quiet time between them.
        hold_s: Waiting time after the last reset [s].
    """

    def __init__(self, *, low_is_safe: bool) -> None:
        self._low_is_safe = low_is_safe
        self.boots, self.resets, self.hold_s = 0, 0, 0.0
        self._reset_s = self._hold_end_s = self._proven_s = -QUIET_S

    def check(self, boots: int, now_s: float) -> int:
        """Return the number of resets since the last check.

        Args:
            boots: Number of boots of the board.
            now_s: Time since boot of the host [s].
        """
        resets, self.boots = boots - self.boots, boots
        if resets:
            self._start(resets, now_s)
            self._proven_s = now_s + max(self.hold_s, FIRST_HOLD_S)
        return resets

    def resume(self, now_s: float) -> None:
        """Wait as after a reset, because the relay may have failed before the restart of the service."""
        self._start(1, now_s)

    def end(self) -> None:
        """End the waiting time, because an alarm was raised. It starts again with the next reset."""
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

    def _start(self, resets: int, now_s: float) -> None:
        if now_s - self._reset_s >= QUIET_S:
            self.resets = 0
        self.resets += resets
        doublings = self.resets - (1 if self._low_is_safe else 2)
        self.hold_s = min(FIRST_HOLD_S * 2.0 ** min(doublings, 10), MAX_HOLD_S) if doublings >= 0 else 0.0
        self._reset_s, self._hold_end_s = now_s, now_s + self.hold_s
