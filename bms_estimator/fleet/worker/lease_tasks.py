"""Leases of a worker, each with the task that processes its messages."""

import asyncio
from collections.abc import Callable, KeysView

from bms_estimator.fleet.worker.lease_totals import LeaseTotals
from bms_estimator.fleet.worker.partition_lease import PartitionLease
from bms_estimator.process.tasks import end

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
