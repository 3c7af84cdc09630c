"""Limit on the processor time that a worker spends on each pack."""

import time
from collections.abc import Callable

MAX_CPU_FRACTION = 0.1
"""Fraction of a core that a pack may use continuously. A source at 1,000 Hz needs 0.005."""
BURST_S = 0.2
"""Processor time that a pack may use in a burst after a pause [s], enough for 500 minute blocks at 1 Hz."""
MAX_CHARGE_S = 0.1
"""Maximum processor time that is charged for one block [s], the cost of 20,000 samples. The first block may take longer,
because it compiles kernels."""
MAX_PACKS = 10_000
"""Number of stored bucket levels above which the levels of idle packs, which are 0, are removed."""


class CpuBudget:
    """Processor-time budget: a leaky bucket for each pack.

    Args:
        clock: Monotonic clock [s].

    Attributes:
        total_s: Processor time of all packs [s].
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self.total_s = 0.0
        # level of each pack's bucket [s], and the time at which the level was computed [s]
        self._levels: dict[str, tuple[float, float]] = {}

    def is_exhausted(self, pack: str) -> bool:
        """Return True if a pack has used up its budget."""
        return self._level_s(pack) > BURST_S

    def charge(self, pack: str, cpu_s: float) -> None:
        """Count processor time that a pack has used [s]."""
        self.total_s += cpu_s
        self._levels[pack] = self._level_s(pack) + min(cpu_s, MAX_CHARGE_S), self._clock()
        if len(self._levels) > MAX_PACKS:
            self._levels = {name: level for name, level in self._levels.items() if self._level_s(name)}

    def _level_s(self, pack: str) -> float:
        level_s, at_s = self._levels.get(pack, (0.0, 0.0))
        return max(level_s - MAX_CPU_FRACTION * (self._clock() - at_s), 0.0)
