"""Leases of a worker with the tasks that process their messages, and totals over all leases since its start."""

import asyncio
from collections import Counter
from collections.abc import Callable, Iterable, KeysView, Mapping

from bms_estimator.fleet.worker.partition_lease import PartitionLease
from bms_estimator.process.tasks import end

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


MAX_RELEASES = 8
"""Maximum number of partitions that are saved and released concurrently."""


class LeaseTasks:
    """Leases by partition. A lease remains until its release has ended.

    Args:
        totals: Totals over all leases, updated before a lease is removed.
        is_connected: Returns True while the worker is connected. Without a connection, a lease ends without a release.
    """

    def __init__(self, totals: LeaseTotals, is_connected: Callable[[], bool]) -> None:
        self._totals, self._is_connected = totals, is_connected
        self._leases: dict[int, PartitionLease] = {}
        self._tasks: dict[int, asyncio.Task[None]] = {}
        self._releases: dict[int, asyncio.Task[None]] = {}
        self._release_slots = asyncio.Semaphore(MAX_RELEASES)

    @property
    def leases(self) -> list[PartitionLease]:
        """All leases, including those whose release has begun."""
        return list(self._leases.values())

    @property
    def numbers(self) -> KeysView[int]:
        """Numbers of the partitions."""
        return self._leases.keys()

    def get(self, number: int) -> PartitionLease | None:
        """Return the lease of a partition; None without one."""
        return self._leases.get(number)

    def start(self, lease: PartitionLease) -> None:
        """Process the messages of a partition until its release."""
        self._leases[lease.number] = lease
        self._tasks[lease.number] = asyncio.create_task(lease.run())

    def start_release(self, number: int) -> None:
        """Begin the release of a partition, unless it has begun."""
        if number not in self._releases:
            self._releases[number] = asyncio.create_task(self._release(number))

    async def release_all(self) -> None:
        """Release all partitions."""
        for number in list(self._leases):
            self.start_release(number)
        await asyncio.gather(*self._releases.values())

    def raise_internal_errors(self) -> None:
        """Raise the error with which a task has ended.

        An internal error must end the process. Otherwise the partition would have no owner.
        """
        for task in [*self._releases.values(), *self._tasks.values()]:
            if task.done() and not task.cancelled():
                task.result()

    async def _release(self, number: int) -> None:
        await end(self._tasks[number])
        async with self._release_slots:
            if self._is_connected():
                await self._leases[number].release()
        self._totals.update(self.leases)
        del self._leases[number], self._tasks[number], self._releases[number]
