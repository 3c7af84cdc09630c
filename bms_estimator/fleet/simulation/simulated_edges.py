"""Sent and repeated blocks of simulated edges: the edge protocol for many at once, without I/O."""

from typing import NamedTuple

import numpy as np

from bms_estimator.edge.subjects import BlockRequest
from bms_estimator.fleet.simulation.simulated_fleet import BLOCK_S, SimulatedFleet, Whole
from bms_estimator.model.arrays import Floats

RESEND_S = 5.0
"""Minimum interval between two resends of a block [s]: a worker that lags repeats its request before the block can
arrive."""


class Due(NamedTuple):
    """Blocks to be sent now, at most one a pack. Arrays of one shape."""

    packs: Whole
    numbers: Whole
    arrival_s: Floats
    """Wall clock of their last samples [s since 1970]."""


class SimulatedEdges:
    """Edges of a fleet. Each one can send any earlier block again, because blocks are computed when needed.

    Args:
        fleet: The packs.
        start_s: Wall clock at which the first block began [s since 1970].
        speed: The packs' seconds per second.
        last: Initial value of the attribute.

    Attributes:
        last: Number of the last block of each edge; None without end.
        next: Number of the block that each edge sends next, shape (packs,).
        safe: Number before which all blocks are safe, as workers reported.
        resends: Number of requests to resend.
        sent: Number of blocks sent, with repetitions.
        again: Number of repetitions.
    """

    def __init__(self, fleet: SimulatedFleet, *, start_s: float, speed: float, last: int | None = None) -> None:
        self._fleet, self._start_s, self._speed, self.last = fleet, start_s, speed, last
        self._index = {name: i for i, name in enumerate(fleet.names)}
        self._later_s = (fleet.store - fleet.begin_ns) / 1e9
        self.next: Whole = np.ones(len(fleet.names), dtype=np.int64)
        self.safe, self._furthest = self.next.copy(), self.next.copy()
        self._asked: Whole = np.zeros(len(fleet.names), dtype=np.int64)
        self._asked_s: Floats = np.full(len(fleet.names), -np.inf)
        self.resends = self.sent = self.again = 0

    def due(self, now_s: float, most: int) -> Due:
        """Return the blocks complete at ``now_s`` [s since 1970] and not sent yet; beyond ``most`` only the oldest."""
        ready_s = self._ready_s(self.next)
        open_ = ready_s <= now_s if self.last is None else (ready_s <= now_s) & (self.next <= self.last)
        packs = np.flatnonzero(open_)
        if packs.size > most:
            packs = packs[np.argpartition(ready_s[packs], most)[:most]]
        numbers = self.next[packs]
        self.next[packs] += 1
        self.sent += packs.size
        self.again += int(np.count_nonzero(numbers < self._furthest[packs]))
        self._furthest[packs] = np.maximum(self._furthest[packs], self.next[packs])
        return Due(packs, numbers, ready_s[packs])

    def hear(self, pack: str, awaits: BlockRequest, now_s: float) -> bool:
        """Receive a worker's message at ``now_s``. Returns whether the pack is one of these, and the store its."""
        i = self._index.get(pack)
        if i is None or awaits.store != self._fleet.store[i]:
            return False
        known, self.safe[i] = self.safe[i], max(self.safe[i], awaits.number)
        if awaits.resend:
            self.resends += 1
            if awaits.number >= known and (awaits.number != self._asked[i] or now_s - self._asked_s[i] >= RESEND_S):
                self.next[i] = min(self.next[i], awaits.number)
                self._asked[i], self._asked_s[i] = awaits.number, now_s
        else:  # what went before this program began is not sent again
            self.next[i] = max(self.next[i], awaits.number)
        return True

    @property
    def done(self) -> bool:
        """True if every edge has sent its last block."""
        return self.last is not None and bool((self.next > self.last).all())

    def lag_s(self, now_s: float) -> float:
        """Age of the oldest complete block that was not sent [s]; 0 without one."""
        ready_s = self._ready_s(self.next)
        return 0.0 if self.done else max(0.0, now_s - float(ready_s.min()))

    def _ready_s(self, numbers: Whole) -> Floats:
        """Wall clock at which a block of each pack is complete [s since 1970]."""
        own_s = self._later_s + numbers * BLOCK_S
        return self._start_s + own_s / self._speed
