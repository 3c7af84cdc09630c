"""Processor time that a worker spends on each pack."""

import time
from collections.abc import Callable

SHARE = 0.1
"""Fraction of a core that a pack may use continuously: a source at 1,000 Hz needs 0.005."""
BURST_S = 0.2
"""Processor time that a pack may use at once after a pause [s]: five hundred minute blocks at 1 Hz."""
MAX_CHARGE_S = 0.1
"""Maximum charge for one block [s], the cost of 20,000 samples. The first block may take longer, because it compiles kernels."""
MAX_PACKS = 10_000
"""Maximum number of levels that are stored before those of idle packs are removed."""


class CpuBudget:
    """A leaky bucket for each pack.

    Args:
        clock: Steady clock [s].
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._spent: dict[str, tuple[float, float]] = {}  # level of the bucket [s], and when it was computed [s]

    def is_exhausted(self, pack: str) -> bool:
        """Return whether a pack has to wait."""
        return self._level_s(pack) > BURST_S

    def charge(self, pack: str, cpu_s: float) -> None:
        """Count processor time that a pack has used [s]."""
        self._spent[pack] = self._level_s(pack) + min(cpu_s, MAX_CHARGE_S), self._clock()
        if len(self._spent) > MAX_PACKS:
            self._spent = {each: spent for each, spent in self._spent.items() if self._level_s(each)}

    def _level_s(self, pack: str) -> float:
        spent_s, at_s = self._spent.get(pack, (0.0, 0.0))
        return max(spent_s - SHARE * (self._clock() - at_s), 0.0)
