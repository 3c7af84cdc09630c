"""Assignment of partitions to workers, which each worker computes from heartbeats. Pure: the clock is an argument.

Rendezvous hashing (Thaler and Ravishankar, "A name-based mapping scheme for rendezvous", 1996) with bounded loads (Mirrokni,
Thorup and Zadimoghaddam, "Consistent hashing with bounded loads", 2016): a partition belongs to the worker with the highest
hash of the pair, unless that worker has its fair number already. Therefore few partitions move when a worker joins or leaves, and
no worker has more than its share. The workers need not agree at each moment: the server's pin decides.
"""

import math
from collections import Counter
from collections.abc import Collection
from hashlib import blake2b

from bms_estimator.fleet.heartbeat import DEAD_S


def assign_partitions(partitions: int, workers: Collection[str]) -> list[str]:
    """Assign each partition to one of the workers, of which there is at least one."""
    most = math.ceil(partitions / len(workers))
    has = Counter[str]()
    found = []
    for number in range(partitions):
        owner = max((each for each in workers if has[each] < most), key=lambda worker: _weight(number, worker))
        has[owner] += 1
        found.append(owner)
    return found


def _weight(partition: int, worker: str) -> tuple[bytes, str]:
    return blake2b(f"{partition} {worker}".encode(), digest_size=8).digest(), worker


class Membership:
    """The workers that are alive.

    Args:
        me: Always one of them, until it leaves.
    """

    def __init__(self, me: str) -> None:
        self.me = me
        self._heard: dict[str, float] = {}
        self._alive: list[str] = []
        self._share: set[int] = set()

    def on_heartbeat(self, worker: str, now_s: float, *, leaving: bool = False) -> bool:
        """Take a heartbeat, at ``now_s`` of a monotonic clock. Whether the worker is new."""
        if leaving:
            self._heard.pop(worker, None)
            return False
        new = worker not in self._heard
        self._heard[worker] = now_s
        return new and worker != self.me

    def extend_all(self, now_s: float) -> None:
        """Extend the deadline of all workers after a time in which none could be received."""
        self._heard = dict.fromkeys(self._heard, now_s)

    def alive(self, now_s: float) -> list[str]:
        """All of them."""
        self._heard = {worker: heard_s for worker, heard_s in self._heard.items() if now_s - heard_s < DEAD_S}
        return sorted({self.me, *self._heard})

    def share(self, partitions: int, now_s: float) -> set[int]:
        """Return the partitions that this worker should claim."""
        alive = self.alive(now_s)
        if alive != self._alive:
            self._alive = alive
            self._share = {
                number for number, owner in enumerate(assign_partitions(partitions, alive)) if owner == self.me
            }
        return self._share
