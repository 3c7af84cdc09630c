"""Live workers, and assignment of partitions to workers, which each worker computes from all heartbeats.

Rendezvous hashing (Thaler and Ravishankar, "A name-based mapping scheme for rendezvous", 1996) with bounded loads (Mirrokni,
Thorup and Zadimoghaddam, "Consistent hashing with bounded loads", 2016): a partition belongs to the worker with the highest
hash of the pair, unless that worker already has its fair share. Therefore few partitions move when a worker joins or leaves.
The workers may disagree for a moment without harm, because the server pins each partition to one worker. A partition that a
worker refuses, because it cannot read the last checkpoint, belongs to another worker.
"""

import math
from collections import Counter
from collections.abc import Collection, Mapping
from hashlib import blake2b

from bms_estimator.fleet.heartbeat import DEAD_S, Heartbeat, RefusedPartition
from bms_estimator.fleet.worker.checkpoint.checkpoint_format import common_format


def assign_partitions(partitions: int, workers: Mapping[str, Collection[int]]) -> list[str | None]:
    """Return the worker of each partition; None if all workers refuse it.

    Args:
        partitions: Number of partitions.
        workers: Partitions that each live worker refuses, by its name; not empty.
    """
    max_partitions = math.ceil(partitions / len(workers))
    counts = Counter[str]()
    owners = list[str | None]()
    for number in range(partitions):
        candidates = [worker for worker, refused in workers.items() if number not in refused]
        below_fair_share = [worker for worker in candidates if counts[worker] < max_partitions]
        weights = {
            worker: blake2b(f"{number} {worker}".encode(), digest_size=8).digest()
            for worker in below_fair_share or candidates
        }
        owner = max(weights, key=lambda worker: (weights[worker], worker), default=None)
        if owner is not None:
            counts[owner] += 1
        owners.append(owner)
    return owners


class Membership:
    """Set of the live workers. All times are of one monotonic clock [s].

    Args:
        me: Name of this worker, which is always a member.

    Attributes:
        refused: Formats of the unreadable checkpoints of the partitions that this worker refuses, by partition.
    """

    def __init__(self, me: str) -> None:
        self.me = me
        self.refused: dict[int, int] = {}
        self._last: dict[str, tuple[float, Heartbeat]] = {}  # arrival and heartbeat of each other worker
        self._alive: dict[str, frozenset[int]] = {}
        self._share: set[int] = set()

    def on_heartbeat(self, heartbeat: Heartbeat, now_s: float) -> bool:
        """Process a heartbeat of another worker. Return True if it is the first one."""
        worker = heartbeat.id
        if worker == self.me:
            return False
        if heartbeat.leaving:
            self._last.pop(worker, None)
            return False
        is_new = worker not in self._last
        self._last[worker] = now_s, heartbeat
        return is_new

    def extend_deadlines(self, now_s: float) -> None:
        """Extend the deadline of all workers after a time without a connection, in which no heartbeat could arrive."""
        self._last = {worker: (now_s, heartbeat) for worker, (_, heartbeat) in self._last.items()}

    def checkpoint_format(self, now_s: float) -> int:
        """Return the format in which checkpoints are written, so that all live workers can read them."""
        return common_format(each.checkpoint_format for each in self._others(now_s).values())

    def refused_partitions(self) -> tuple[RefusedPartition, ...]:
        """Return the partitions that this worker refuses, in the order of their numbers."""
        return tuple(RefusedPartition(partition=number, format=self.refused[number]) for number in sorted(self.refused))

    def share(self, partitions: int, now_s: float) -> set[int]:
        """Return the partitions that this worker should claim."""
        alive = {self.me: frozenset(self.refused)} | {
            worker: frozenset(each.partition for each in heartbeat.refused)
            for worker, heartbeat in self._others(now_s).items()
        }
        if alive != self._alive:
            self._alive = alive
            self._share = {
                number for number, owner in enumerate(assign_partitions(partitions, alive)) if owner == self.me
            }
        return self._share

    def _others(self, now_s: float) -> dict[str, Heartbeat]:
        """Return the last heartbeat of each other live worker."""
        self._last = {worker: last for worker, last in self._last.items() if now_s - last[0] < DEAD_S}
        return {worker: heartbeat for worker, (_, heartbeat) in self._last.items()}
