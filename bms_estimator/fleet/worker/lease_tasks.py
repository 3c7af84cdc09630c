"""Leases of a worker: tasks that process their messages, and periodic tasks over all leases.

The periodic tasks store checkpoints and results, check for unsaved blocks, and report unknown packs.
"""

import asyncio
import time
from collections.abc import Awaitable, Callable, Iterable, KeysView, Sequence

import structlog
from nats.aio.client import Client

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.connection import RETRYABLE_ERRORS, error_text
from bms_estimator.fleet.nats.unsaved_blocks import unsaved_blocks
from bms_estimator.fleet.packs.pack_registry import PackRegistry
from bms_estimator.fleet.worker.partition_lease import PartitionLease
from bms_estimator.process.runtime import end_tasks

log = structlog.get_logger(__name__)

MAX_RELEASES = 8
"""Maximum number of partitions that are saved and released concurrently."""


class LeaseTasks:
    """Leases of a worker and their tasks. A lease is removed after its release.

    Args:
        is_connected: Returns True while the worker is connected. Without a connection, a lease ends without a release.
    """

    def __init__(self, is_connected: Callable[[], bool]) -> None:
        self._is_connected = is_connected
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
        """Start a task that processes the messages of a partition until its release."""
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
        await end_tasks(self._tasks[number])
        async with self._release_slots:
            if self._is_connected():
                await self._leases[number].release()
        self._leases[number].drop()
        del self._leases[number], self._tasks[number], self._releases[number]


class PeriodicStorage:
    """Storage of due checkpoints, and of summaries and dead letters that the server has not acknowledged yet.

    Args:
        nc: Connection to the tenant's NATS account.
        interval_s: Interval between two checkpoints of a partition [s].
        partitions: Total number of partitions.

    Attributes:
        checkpoint_s: Duration of the last written checkpoint [s]; None before the first.
    """

    def __init__(self, nc: Client, interval_s: float, partitions: int) -> None:
        self._nc, self._interval_s, self._partitions = nc, interval_s, partitions
        self.checkpoint_s: float | None = None

    def first_due_s(self, number: int, now_s: float) -> float:
        """Return the time of a partition's first checkpoint. The checkpoints of the partitions are spread over the interval."""
        return now_s + self._interval_s * (number + 1) / self._partitions

    async def save(self, leases: Sequence[PartitionLease]) -> None:
        """Write the due checkpoints, and again those whose format is too new for another live worker."""
        for lease in sorted(leases, key=lambda each: each.checkpoint_due_s):
            now_s = time.monotonic()
            if (lease.checkpoint_due_s <= now_s or lease.is_checkpoint_too_new) and self._nc.is_connected:
                lease.checkpoint_due_s, previous = now_s + self._interval_s, lease.last_checkpoint
                await self._try(lease, "checkpoint", lease.save)
                if lease.last_checkpoint != previous:
                    self.checkpoint_s = time.monotonic() - now_s

    async def send_results(self, leases: Sequence[PartitionLease]) -> None:
        """Send the queued summaries and dead letters again."""
        for lease in leases:
            # also without queued messages, because the save of a checkpoint may have sent those that failed here
            if self._nc.is_connected:
                await self._try(lease, "results", lease.results.send_queued)

    async def _try(self, lease: PartitionLease, kind: str, action: Callable[[], Awaitable[None]]) -> None:
        """Run ``action``. After an error of connection or server, the next call that is due tries again."""
        try:
            await action()
        except RETRYABLE_ERRORS as error:
            event, reason = "a checkpoint, summary or dead letter could not be stored; trying again", error_text(error)
            log.warning(event, partition=lease.number, reason=reason)
            lease.storage_troubles[kind] = f"{event}: {reason}"
        else:
            lease.storage_troubles.pop(kind, None)


class UnsavedCheck:
    """Check for unsaved blocks (``nats.unsaved_blocks``) in the partitions of one worker.

    Args:
        nc: Connection to the tenant's NATS account.

    Attributes:
        warning: Present warning; empty without one.
    """

    def __init__(self, nc: Client) -> None:
        self._nc, self.warning = nc, ""

    async def run(self, partitions: Iterable[int]) -> None:
        """Check the given partitions, and log a new warning."""
        if not self._nc.is_connected:
            return
        try:
            warning = (await unsaved_blocks(self._nc, partitions)).warning
        except RETRYABLE_ERRORS as error:
            warning = f"the streams cannot be read: {error_text(error)}"
        if warning and not self.warning:
            log.warning("blocks may be lost that no checkpoint includes", reason=warning)
        self.warning = warning


class UnknownPacks:
    """Reporter of the unknown packs of a worker.

    Args:
        nc: Connection to the tenant's NATS account.
        packs: Table of packs.
    """

    def __init__(self, nc: Client, packs: PackRegistry) -> None:
        self._nc, self._packs = nc, packs
        self._reported: set[str] = set()

    async def publish(self, leases: Iterable[PartitionLease]) -> None:
        """Publish the reason for each pack that has become unknown."""
        unknown = {pack for lease in leases if lease.partition for pack in lease.partition.unknown}
        for pack in unknown - self._reported:
            reason = self._packs.reason(pack)
            log.warning("unknown pack: its blocks are deferred", pack=pack, reason=reason)
            await self._nc.publish(subjects.unknown(pack), reason.encode())
        self._reported = unknown
