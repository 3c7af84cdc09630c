"""Repeated resets of the sensor board, which raise the alarm ``sensor_fault``."""

from collections import deque

WINDOW_S = 1800.0
"""Time within which resets count as repeated [s]. It covers three resets at the longest waiting time of the relay."""
REPEATED = 3
"""Number of resets within ``WINDOW_S`` that raise the alarm. A cable that is plugged in again causes one."""
REASON = f"the board was reset at least {REPEATED} times within {WINDOW_S / 60:.0f} min; check its supply and its cable"
"""Reason of the alarm."""


class BoardResets:
    """Times of the last resets of the board."""

    def __init__(self) -> None:
        self._resets = 0
        self._times_s = deque[float](maxlen=REPEATED)

    def update(self, resets: int, now_s: float) -> str:
        """Return ``REASON`` while resets are repeated, otherwise an empty text.

        Args:
            resets: Number of resets since start.
            now_s: Monotonic clock [s].
        """
        self._times_s.extend([now_s] * min(resets - self._resets, REPEATED))
        self._resets = resets
        is_repeated = len(self._times_s) == REPEATED and now_s - self._times_s[0] < WINDOW_S
        return REASON if is_repeated else ""
