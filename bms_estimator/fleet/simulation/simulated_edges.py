"""Schedule of the blocks that many simulated edges send and resend. No I/O."""

from typing import NamedTuple

import numpy as np

from bms_estimator.edge.subjects import BlockRequest
from bms_estimator.fleet.simulation.simulated_fleet import BLOCK_S, Ints, SimulatedFleet
from bms_estimator.model.arrays import Floats

RESEND_S = 5.0
"""Minimum interval between two resends of a block [s], because a lagging worker repeats its request before the resent block
arrives."""


class Due(NamedTuple):
    """Due blocks, at most one of each pack. Arrays of equal shape."""

    packs: Ints
    numbers: Ints
    arrival_s: Floats
    """Wall clock of their last samples [s since 1970]."""


class SimulatedEdges:
    """Edges of a fleet. Each one can resend any block, because blocks are computed when needed.

    Args:
        fleet: Simulated packs.
        start_s: Wall clock at which the first block began [s since 1970].
        speed: Simulated seconds per second.
        last: Number of the last block of each edge; None: the edges send without end.

    Attributes:
        last: Argument ``last``, which may be changed.
        next_number: Number of the block that each edge sends next, shape (packs,). A request for an earlier block lowers it.
        first_unsent: Lowest number that each edge has never sent, shape (packs,).
        confirmed_below: Number of the first unconfirmed block of each edge, shape (packs,).
        resends: Number of requests to resend.
        sent: Number of blocks sent, with repetitions.
        repeated: Number of blocks sent that were sent before.
    """

    def __init__(self, fleet: SimulatedFleet, *, start_s: float, speed: float, last: int | None = None) -> None:
        self._fleet, self._start_s, self._speed, self.last = fleet, start_s, speed, last
        self._index = {name: i for i, name in enumerate(fleet.names)}
        self._store_offset_s = (fleet.store_created_ns - fleet.begin_ns) / 1e9
        self.next_number: Ints = np.ones(len(fleet.names), dtype=np.int64)
        self.confirmed_below = self.next_number.copy()
        self.first_unsent = self.next_number.copy()
        self._requested: Ints = np.zeros(len(fleet.names), dtype=np.int64)
        self._requested_s: Floats = np.full(len(fleet.names), -np.inf)
        self.resends = self.sent = self.repeated = 0

    def due(self, now_s: float, max_blocks: int) -> Due:
        """Return up to ``max_blocks`` of the oldest blocks that are complete at ``now_s`` [s since 1970] and not sent yet."""
        ready_s = self._ready_s(self.next_number)
        is_due = ready_s <= now_s if self.last is None else (ready_s <= now_s) & (self.next_number <= self.last)
        packs = np.flatnonzero(is_due)
        if packs.size > max_blocks:
            packs = packs[np.argpartition(ready_s[packs], max_blocks)[:max_blocks]]
        numbers = self.next_number[packs]
        self.next_number[packs] += 1
        self.sent += packs.size
        self.repeated += int(np.count_nonzero(numbers < self.first_unsent[packs]))
        self.first_unsent[packs] = np.maximum(self.first_unsent[packs], self.next_number[packs])
        return Due(packs, numbers, ready_s[packs])

    def receive_reply(self, pack: str, reply: BlockRequest, now_s: float) -> bool:
        """Process a worker's reply. Return False if the reply is for another fleet's pack or store."""
        i = self._index.get(pack)
        if i is None or reply.store != self._fleet.store_created_ns[i]:
            return False
        number = self.confirmed_below[i] = max(self.confirmed_below[i], reply.number)
        if reply.resend:
            self.resends += 1
            if number != self._requested[i] or now_s - self._requested_s[i] >= RESEND_S:
                self.next_number[i] = min(self.next_number[i], number)
                self._requested[i], self._requested_s[i] = number, now_s
        else:  # skip blocks that an earlier run has sent
            self.next_number[i] = max(self.next_number[i], reply.number)
        return True

    @property
    def done(self) -> bool:
        """True if every edge has sent its last block."""
        return self.last is not None and bool((self.next_number > self.last).all())

    def lag_s(self, now_s: float) -> float:
        """Return the age of the oldest due block that was not sent [s]; 0 without one."""
        ready_s = self._ready_s(self.next_number)
        return 0.0 if self.done else max(0.0, now_s - float(ready_s.min()))

    def _ready_s(self, numbers: Ints) -> Floats:
        """Return the wall clock at which a block of each pack is complete [s since 1970]."""
        end_s = self._store_offset_s + numbers * BLOCK_S
        return self._start_s + end_s / self._speed
