"""Totals of a worker since its start, over its present leases and the released ones."""

from collections import Counter
from collections.abc import Iterable, Mapping

from bms_estimator.fleet.worker.partition_lease import PartitionLease

PROCESSED = frozenset({"blocks", "samples", "packs", "unknown"})
"""Counters of a partition that are no events: the heartbeat has them in fields of their own."""


class SourceSum:
    """Sum of the counters of changing sources. It does not fall when a source disappears."""

    def __init__(self) -> None:
        self._former = Counter[str]()
        self._present: Mapping[object, Counter[str]] = {}

    def update(self, present: Mapping[object, Counter[str]]) -> None:
        """Set the counters of the present sources."""
        for source in self._present.keys() - present.keys():
            self._former.update(self._present[source])
        self._present = present

    def total(self) -> Counter[str]:
        """Return the sum over present and former sources."""
        return sum(self._present.values(), self._former)


class LeaseTotals:
    """Totals over all leases of a worker since its start."""

    def __init__(self) -> None:
        self._runs, self._events = SourceSum(), SourceSum()

    def update(self, leases: Iterable[PartitionLease]) -> None:
        """Read the counters of the present leases. Call it before a lease is removed."""
        self._runs.update({lease.runner: _run_counts(lease) for lease in leases})
        self._events.update({lease.partition: _event_counts(lease) for lease in leases if lease.partition})

    def processed(self) -> dict[str, int]:
        """Return the numbers of blocks, samples, faults and dead letters."""
        counts = self._runs.total()
        return {name: counts[name] for name in ("blocks", "samples", "faults", "dead_letters")}

    def estimation_s(self) -> float:
        """Return the processor time of estimation [s]."""
        return self._runs.total()["estimation_us"] / 1e6

    def events(self) -> dict[str, int]:
        """Return the numbers of events of the partitions by name, from the claim of each partition on."""
        return dict(self._events.total())


def _run_counts(lease: PartitionLease) -> Counter[str]:
    runner = lease.runner
    return Counter(
        blocks=runner.blocks,
        samples=runner.samples,
        faults=runner.faults,
        dead_letters=runner.dead_letters,
        estimation_us=round(1e6 * runner.budget.total_s),
    )


def _event_counts(lease: PartitionLease) -> Counter[str]:
    if lease.partition is None:
        return Counter()
    counted = Counter(lease.partition.counters) - Counter(lease.restored_counters)
    return Counter({name: count for name, count in counted.items() if name not in PROCESSED})
