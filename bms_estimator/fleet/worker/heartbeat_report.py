"""Heartbeat of a worker."""

import resource
import time
from collections import Counter
from collections.abc import Sequence
from heapq import nlargest
from pathlib import Path

from bms_estimator.edge.block import VERSION as BLOCK_VERSION
from bms_estimator.fleet.heartbeat import Heartbeat, RefusedPartition
from bms_estimator.fleet.worker.block_runner import Totals
from bms_estimator.fleet.worker.checkpoint.checkpoint_format import FORMAT, oldest_format
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
