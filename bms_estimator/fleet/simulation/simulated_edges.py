"""Schedule of the blocks that many simulated edges send and resend. No I/O."""

from typing import NamedTuple

import numpy as np

from bms_estimator.edge.subjects import BlockRequest
from bms_estimator.fleet.simulation.simulated_fleet import BLOCK_S, SimulatedFleet, Whole
from bms_estimator.model.arrays import Floats

RESEND_S = 5.0
"""Minimum interval between two resends of a block [s]: a lagging worker repeats its request before the resent block can
arrive."""


class Due(NamedTuple):
    """Due blocks, at most one of each pack. Arrays of equal shape."""

    packs: Whole
    numbers: Whole
    arrival_s: Floats
    """Wall clock of their last samples [s since 1970]."""


class SimulatedEdges:
    """Edges of a fleet. Each one can resend any block, because blocks are computed when needed.

    Args:
        fleet: Simulated packs.
        start_s: Wall clock at which the first block began [s since 1970].
        speed: Simulated seconds per second.
        last: Initial value of the attribute ``last``.

    Attributes:
        last: Number of the last block of each edge; None without end.
        next: Number of the block that each edge sends next, shape (packs,).
        safe: Number of each edge below which workers have confirmed all blocks, shape (packs,).
        resends: Number of requests to resend.
        sent: Number of blocks sent, with repetitions.
        again: Number of repetitions.
    """

    def __init__(self, fleet: SimulatedFleet, *, start_s: float, speed: float, last: int | None = None) -> None:
        self._fleet, self._start_s, self._speed, self.last = fleet, start_s, speed, last
        self._index = {name: i for i, name in enumerate(fleet.names)}
        self._store_offset_s = (fleet.store - fleet.begin_ns) / 1e9
        self.next: Whole = np.ones(len(fleet.names), dtype=np.int64)
        self.safe, self._furthest = self.next.copy(), self.next.copy()
        self._requested: Whole = np.zeros(len(fleet.names), dtype=np.int64)
        self._requested_s: Floats = np.full(len(fleet.names), -np.inf)
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

    def receive_reply(self, pack: str, reply: BlockRequest, now_s: float) -> bool:
        """Process a worker's reply. Return False if the reply is for another fleet's pack or store."""
        i = self._index.get(pack)
        if i is None or reply.store != self._fleet.store[i]:
            return False
        safe_before, self.safe[i] = self.safe[i], max(self.safe[i], reply.number)
        if reply.resend:
            self.resends += 1
            if reply.number >= safe_before and (
                reply.number != self._requested[i] or now_s - self._requested_s[i] >= RESEND_S
            ):
                self.next[i] = min(self.next[i], reply.number)
                self._requested[i], self._requested_s[i] = reply.number, now_s
        else:  # skip blocks that an earlier run has sent
            self.next[i] = max(self.next[i], reply.number)
        return True

    @property
    def done(self) -> bool:
        """True if every edge has sent its last block."""
        return self.last is not None and bool((self.next > self.last).all())

    def lag_s(self, now_s: float) -> float:
        """Return the age of the oldest due block that was not sent [s]; 0 without one."""
        ready_s = self._ready_s(self.next)
        return 0.0 if self.done else max(0.0, now_s - float(ready_s.min()))

    def _ready_s(self, numbers: Whole) -> Floats:
        """Return the wall clock at which a block of each pack is complete [s since 1970]."""
        end_s = self._store_offset_s + numbers * BLOCK_S
        return self._start_s + end_s / self._speed
