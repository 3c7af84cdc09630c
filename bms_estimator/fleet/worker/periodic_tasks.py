"""Periodic tasks of a worker: storage of checkpoints and results, checks of stream and partitions, reports of unknown packs."""

import time
from collections.abc import Awaitable, Callable, Iterable, Sequence

import structlog
from nats.aio.client import Client

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.connection import error_text
from bms_estimator.fleet.nats.unsaved_blocks import unsaved_blocks
from bms_estimator.fleet.packs.pack_registry import PackRegistry
from bms_estimator.fleet.worker.checkpoint.checkpoint_store import CheckpointStore
from bms_estimator.fleet.worker.checkpoint.format_versions import UnreadableFormatError
from bms_estimator.fleet.worker.heartbeats import Membership
from bms_estimator.fleet.worker.partition_lease import PartitionLease
from bms_estimator.fleet.worker.retry import RETRYABLE_ERRORS

log = structlog.get_logger(__name__)


class PeriodicStorage:
    """Storage of due checkpoints, and of summaries and dead letters that the server has not acknowledged yet.

    Args:
        nc: Connection to the tenant's NATS account.
        interval_s: Interval between two checkpoints of a partition [s].
        partitions: Total number of partitions.

    Attributes:
        checkpoint_s: Duration of the last written checkpoint [s]; None before the first.
        troubles: Errors of the last attempts to store something, by partition.
    """

    def __init__(self, nc: Client, interval_s: float, partitions: int) -> None:
        self._nc, self._interval_s, self._partitions = nc, interval_s, partitions
        self.checkpoint_s: float | None = None
        self.troubles: dict[int, str] = {}

    def first_due_s(self, number: int, now_s: float) -> float:
        """Return the time of a partition's first checkpoint. The checkpoints of the partitions are spread over the interval."""
        return now_s + self._interval_s * (number + 1) / self._partitions

    async def save(self, leases: Sequence[PartitionLease]) -> None:
        """Write the due checkpoints, and replace those that a live worker cannot read."""
        for lease in sorted(leases, key=lambda each: each.checkpoint_due_s):
            now_s = time.monotonic()
            if (lease.checkpoint_due_s <= now_s or lease.is_checkpoint_too_new) and self._nc.is_connected:
                lease.checkpoint_due_s, previous = now_s + self._interval_s, lease.last_checkpoint
                await self._try(lease, lease.save)
                if lease.last_checkpoint != previous:
                    self.checkpoint_s = time.monotonic() - now_s

    async def send_results(self, leases: Sequence[PartitionLease]) -> None:
        """Send the queued summaries and dead letters again."""
        for lease in leases:
            if lease.results.is_waiting and self._nc.is_connected:
                await self._try(lease, lease.results.send_queued)

    async def _try(self, lease: PartitionLease, action: Callable[[], Awaitable[None]]) -> None:
        """Run ``action``. After an error of connection or server, the next periodic call tries again."""
        self.troubles.pop(lease.number, None)
        try:
            await action()
        except RETRYABLE_ERRORS as error:
            event, reason = "a checkpoint, summary or dead letter could not be stored; trying again", error_text(error)
            log.warning(event, partition=lease.number, reason=reason)
            self.troubles[lease.number] = f"{event}: {reason}"


class UnsavedCheck:
    """Check of the partitions of one worker.

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


async def check_refused(numbers: Iterable[int], members: Membership, checkpoints: CheckpointStore) -> None:
    """Accept the refused partitions whose checkpoints another worker has written in a readable format since."""
    for number in numbers:
        try:
            await checkpoints.claims.check_format(number)
        except UnreadableFormatError as error:
            members.refused[number] = error.found
        except RETRYABLE_ERRORS as error:
            log.warning("a refused partition cannot be checked", partition=number, reason=error_text(error))
        else:
            log.info("the checkpoint of a refused partition has become readable", partition=number)
            del members.refused[number]


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
