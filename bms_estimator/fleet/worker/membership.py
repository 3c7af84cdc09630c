"""Assignment of partitions to workers, computed by each worker from heartbeats. The clock is an argument.

Rendezvous hashing (Thaler and Ravishankar, "A name-based mapping scheme for rendezvous", 1996) with bounded loads (Mirrokni,
Thorup and Zadimoghaddam, "Consistent hashing with bounded loads", 2016): a partition belongs to the worker with the highest
hash of the pair, unless that worker already has its fair share. Therefore few partitions move when a worker joins or leaves.
The workers may disagree for a moment without harm, because the server pins each partition to one worker.
"""

import math
from collections import Counter
from collections.abc import Collection
from hashlib import blake2b

from bms_estimator.fleet.heartbeat import DEAD_S


def assign_partitions(partitions: int, workers: Collection[str]) -> list[str]:
    """Return the worker of each partition.

    Args:
        partitions: Number of partitions.
        workers: Names of the live workers; not empty.
    """
    max_partitions = math.ceil(partitions / len(workers))
    counts = Counter[str]()
    owners = []
    for number in range(partitions):
        owner = max(
            (each for each in workers if counts[each] < max_partitions), key=lambda worker: _weight(number, worker)
        )
        counts[owner] += 1
        owners.append(owner)
    return owners


def _weight(partition: int, worker: str) -> tuple[bytes, str]:
    return blake2b(f"{partition} {worker}".encode(), digest_size=8).digest(), worker


class Membership:
    """Set of the live workers. All times are of one monotonic clock [s].

    Args:
        me: Name of this worker, which is always a member.
    """

    def __init__(self, me: str) -> None:
        self.me = me
        self._last_heartbeat_s: dict[str, float] = {}
        self._alive: list[str] = []
        self._share: set[int] = set()

    def on_heartbeat(self, worker: str, now_s: float, *, leaving: bool = False) -> bool:
        """Process a heartbeat. Return True if it is the first heartbeat of another worker."""
        if leaving:
            self._last_heartbeat_s.pop(worker, None)
            return False
        is_new = worker not in self._last_heartbeat_s
        self._last_heartbeat_s[worker] = now_s
        return is_new and worker != self.me

    def extend_all(self, now_s: float) -> None:
        """Extend the deadline of all workers after a time without a connection, in which no heartbeat could arrive."""
        self._last_heartbeat_s = dict.fromkeys(self._last_heartbeat_s, now_s)

    def alive(self, now_s: float) -> list[str]:
        """Return the names of all live workers, sorted."""
        self._last_heartbeat_s = {
            worker: last_s for worker, last_s in self._last_heartbeat_s.items() if now_s - last_s < DEAD_S
        }
        return sorted({self.me, *self._last_heartbeat_s})

    def share(self, partitions: int, now_s: float) -> set[int]:
        """Return the partitions that this worker should claim."""
        alive = self.alive(now_s)
        if alive != self._alive:
            self._alive = alive
            self._share = {
                number for number, owner in enumerate(assign_partitions(partitions, alive)) if owner == self.me
            }
        return self._share
