"""Heartbeat of a worker from its leases."""

import resource
import time
from collections import Counter
from collections.abc import Sequence
from heapq import nlargest
from pathlib import Path

from bms_estimator.edge.block import VERSION as BLOCK_VERSION
from bms_estimator.fleet.heartbeat import Heartbeat, RefusedPartition
from bms_estimator.fleet.worker.checkpoint.format_versions import FORMAT, oldest_format
from bms_estimator.fleet.worker.lease_totals import LeaseTotals
from bms_estimator.fleet.worker.partition_lease import PartitionLease
from bms_estimator.version import __version__

MAX_LISTED = 20
"""Maximum number of packs of each kind that a heartbeat names: unknown packs, packs with a wrong clock."""


class HeartbeatReport:
    """Maker of the heartbeats of one worker.

    Args:
        name: Name of the worker.

    Attributes:
        started_s: Wall clock at the worker's start [s since 1970].
        totals: Totals over all leases since the start.
    """

    def __init__(self, name: str) -> None:
        self._name, self.started_s, self.totals = name, time.time(), LeaseTotals()
        # monotonic clock since which a partition has blocks that its checkpoint of this sequence number does not include
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
        self.totals.update(leases)
        owned_leases = [lease for lease in leases if lease.is_owned]
        counters, unknown, clock_errors = Counter[str](), list[str](), dict[str, float]()
        for lease in owned_leases:
            if lease.partition:
                counters.update(lease.partition.counters)
                unknown += lease.partition.unknown
                clock_errors |= lease.partition.clock_errors
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
            **self.totals.processed(),
            events=self.totals.events(),
            lag_s=_take_lag_s(owned_leases),
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
            estimation_s=self.totals.estimation_s(),
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


def _take_lag_s(leases: Sequence[PartitionLease]) -> float | None:
    """Return the largest lag since the previous call [s]; None without a block."""
    lags = [lease.runner.lag_s for lease in leases if lease.runner.lag_s is not None]
    for lease in leases:
        lease.runner.lag_s = None
    return max(lags, default=None)


def _rss_mib() -> float:
    resident_pages = int(Path("/proc/self/statm").read_text().split()[1])  # second field
    return resident_pages * resource.getpagesize() / 2**20
