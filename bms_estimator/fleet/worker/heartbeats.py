"""Heartbeat of a worker, and assignment of partitions to workers, which each worker computes from all heartbeats.

Rendezvous hashing (Thaler and Ravishankar, "A name-based mapping scheme for rendezvous", 1996) with bounded loads (Mirrokni,
Thorup and Zadimoghaddam, "Consistent hashing with bounded loads", 2016): a partition belongs to the worker with the highest
hash of the pair, unless that worker already has its fair share. Therefore few partitions move when a worker joins or leaves.
The workers may disagree for a moment without harm, because the server pins each partition to one worker. A partition that a
worker refuses, because it cannot read the last checkpoint, belongs to another worker.
"""

import math
import resource
import time
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from hashlib import blake2b
from heapq import nlargest
from pathlib import Path

from bms_estimator.edge.block import VERSION as BLOCK_VERSION
from bms_estimator.fleet.heartbeat import DEAD_S, Heartbeat, RefusedPartition
from bms_estimator.fleet.worker.block_runner import Totals
from bms_estimator.fleet.worker.checkpoint.checkpoint_format import FORMAT, common_format, oldest_format
from bms_estimator.fleet.worker.partition_lease import PartitionLease
from bms_estimator.version import __version__

NOT_EVENTS = frozenset({"blocks", "samples"})
"""Counters of a partition that are no events. The heartbeat has separate fields for them."""
MAX_LISTED = 20
"""Maximum number of unknown packs, and of packs with a wrong clock, that a heartbeat names."""


class HeartbeatReport:
    """Builder of the heartbeats of one worker.

    Args:
        name: Name of the worker.
        totals: Totals of the worker. The largest lag is reset with each heartbeat.

    Attributes:
        started_s: Wall clock at the worker's start [s since 1970].
    """

    def __init__(self, name: str, totals: Totals) -> None:
        self._name, self.started_s, self._totals = name, time.time(), totals
        # monotonic time since which blocks of a partition are unsaved, by lease and sequence number of its checkpoint
        self._unsaved_since: dict[tuple[PartitionLease, int], float] = {}

    def make(
        self,
        leases: Sequence[PartitionLease],
        refused: tuple[RefusedPartition, ...],
        *,
        leaving: bool,
        reconnects: int,
        checkpoint_s: float | None,
        trouble: str,
    ) -> Heartbeat:
        """Return the present heartbeat, and begin a new interval for the largest lag.

        Args:
            leases: Present leases.
            refused: Refused partitions.
            leaving: True while the worker releases its partitions before it ends.
            reconnects: Number of reconnections to the server.
            checkpoint_s: Duration of the last checkpoint [s].
            trouble: Description of the present error.
        """
        totals, owned_leases = self._totals, [lease for lease in leases if lease.is_owned]
        counters, events, unknown, clock_errors = Counter[str](), totals.events.copy(), list[str](), dict[str, float]()
        for lease in owned_leases:
            if lease.partition:
                counters.update(lease.partition.counters)
                events.update(lease.partition.events)
                unknown += lease.partition.unknown
                clock_errors |= lease.partition.clock_errors
        lag_s, totals.lag_s = totals.lag_s, None
        usage = resource.getrusage(resource.RUSAGE_SELF)
        return Heartbeat(
            id=self._name,
            started_s=self.started_s,
            version=__version__,
            checkpoint_format=FORMAT,
            oldest_checkpoint_format=oldest_format(),
            block_version=BLOCK_VERSION,
            refused=refused,
            leaving=leaving,
            partitions=tuple(lease.number for lease in owned_leases),
            packs=counters["packs"],
            blocks=totals.blocks,
            samples=totals.samples,
            faults=totals.faults,
            dead_letters=totals.dead_letters,
            events={name: count for name, count in events.items() if name not in NOT_EVENTS},
            lag_s=lag_s,
            counters=dict(counters),
            unknown_count=len(unknown),
            unknown=tuple(sorted(unknown)[:MAX_LISTED]),
            clock_error_count=len(clock_errors),
            clock_errors=dict(nlargest(MAX_LISTED, clock_errors.items(), key=lambda each: abs(each[1]))),
            waiting=sum(len(lease.consumer.waiting) for lease in leases),
            hours_waiting=sum(len(lease.results.waiting) for lease in leases),
            unsaved_s=self._unsaved_s(owned_leases),
            checkpoint_s=checkpoint_s,
            cpu_s=usage.ru_utime + usage.ru_stime,
            estimation_s=totals.estimation_s,
            rss_mib=_rss_mib(),
            reconnects=reconnects,
            trouble=trouble,
        )

    def _unsaved_s(self, leases: Sequence[PartitionLease]) -> float:
        """Return the largest time for which a partition has had blocks that its last checkpoint does not include [s]."""
        now_s, since = time.monotonic(), {}
        for lease in leases:
            saved = lease.last_checkpoint.sequence if lease.last_checkpoint else 0
            if lease.partition and lease.partition.sequence > saved:
                since[lease, saved] = self._unsaved_since.get((lease, saved), now_s)
        self._unsaved_since = since
        return now_s - min(since.values(), default=now_s)


def _rss_mib() -> float:
    resident_pages = int(Path("/proc/self/statm").read_text().split()[1])
    return resident_pages * resource.getpagesize() / 2**20


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
        weights = {worker: _weight(number, worker) for worker in below_fair_share or candidates}
        owner = max(weights, key=lambda worker: (weights[worker], worker), default=None)
        if owner is not None:
            counts[owner] += 1
        owners.append(owner)
    return owners


def _weight(partition: int, worker: str) -> bytes:
    return blake2b(f"{partition} {worker}".encode(), digest_size=8).digest()


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
