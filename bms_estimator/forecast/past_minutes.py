"""Load of past discharges, minute by minute, and the search in it for analogues: loads like the present one."""

import numpy as np

from bms_estimator.forecast.given_load import GivenLoad
from bms_estimator.forecast.load_history import LoadHistory
from bms_estimator.kernels.forecast.load_seconds import MAX_LOAD_S
from bms_estimator.model.arrays import Floats

MINUTE_S = 60
"""Length of a minute [s]."""
MAX_MINUTES = 20_000
"""Maximum number of stored minutes: a year with 55 minutes of use a day."""
COMPARED_MINUTES = 20
"""Length of the latest load that is compared with earlier ones [min]."""
MAX_DIFFERENCE = 0.25
"""Maximum difference of an analogue from the latest load: mean absolute difference, relative to the mean of the latest load."""
MIN_AHEAD_MINUTES = 30
"""Minimum length of the load that followed an analogue [min]. A forecast uses that load as the future one."""
MAX_ANALOGUES = 10
"""Maximum number of analogues. If there are more, the most similar ones are used."""
PEAK_S = 5.0
"""Assumed duration of the largest current of a minute [s]. Only the current itself is stored."""


class PastMinutes:
    """Mean and largest current of each minute that ``LoadHistory`` stores, also of discharges before the last charge.

    Attributes:
        mean_a: Mean current of each minute [A], oldest first, positive on discharge.
        max_a: Largest current of each minute [A].
    """

    def __init__(self) -> None:
        self.mean_a: Floats = np.zeros(0)
        self.max_a: Floats = np.zeros(0)
        self._next = 0  # index in the ring buffer of ``LoadHistory``: first second not yet added

    def add(self, load: LoadHistory) -> None:
        """Add the complete minutes of a load since the previous call."""
        end = int(load.record["next"][0])
        new = min((end - self._next) % MAX_LOAD_S, load.seconds)
        minutes = new // MINUTE_S
        if minutes == 0:
            return
        mean_a, max_a = (column[load.seconds - new :][: minutes * MINUTE_S] for column in load.mean_and_max())
        self._next = (end - new + minutes * MINUTE_S) % MAX_LOAD_S
        self.mean_a = np.append(self.mean_a, mean_a.reshape(-1, MINUTE_S).mean(axis=1))[-MAX_MINUTES:]
        self.max_a = np.append(self.max_a, max_a.reshape(-1, MINUTE_S).max(axis=1))[-MAX_MINUTES:]

    def restore(self, mean_a: Floats, max_a: Floats, load: LoadHistory) -> None:
        """Restore saved minutes, which already include the seconds of ``load``."""
        self.mean_a, self.max_a, self._next = mean_a, max_a, int(load.record["next"][0])

    def analogues(self, present_minutes: int) -> list[GivenLoad]:
        """Return the loads that followed the analogues in earlier discharges, the load after the most similar one first.

        Args:
            present_minutes: Number of the last minutes that belong to the present discharge.
        """
        earlier = self.mean_a.size - present_minutes
        if present_minutes < COMPARED_MINUTES or earlier < COMPARED_MINUTES + MIN_AHEAD_MINUTES:
            return []
        present = self.mean_a[-COMPARED_MINUTES:]
        windows = np.lib.stride_tricks.sliding_window_view(self.mean_a[: earlier - MIN_AHEAD_MINUTES], COMPARED_MINUTES)
        difference = np.abs(windows - present).mean(axis=1) / max(float(np.abs(present).mean()), 1e-9)
        ends = list[int]()
        while len(ends) < MAX_ANALOGUES and difference.min() <= MAX_DIFFERENCE:
            best = int(difference.argmin())
            ends.append(best + COMPARED_MINUTES)
            # a window that overlaps this one is not another analogue
            difference[max(best - COMPARED_MINUTES, 0) : best + COMPARED_MINUTES] = np.inf
        return [self._load_after(end) for end in ends]

    def _load_after(self, end: int) -> GivenLoad:
        """Return the load from the minute ``end`` on. Each minute has its mean, and its largest current for ``PEAK_S``."""
        mean_a, max_a = self.mean_a[end:], self.max_a[end:]
        others_a = (mean_a * MINUTE_S - max_a * PEAK_S) / (MINUTE_S - PEAK_S)
        current_a = np.stack([others_a, max_a], axis=1).ravel()
        duration_s = np.tile([MINUTE_S - PEAK_S, PEAK_S], mean_a.size)
        return GivenLoad(duration_s, current_a, np.full(current_a.size, np.nan))
