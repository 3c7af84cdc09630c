"""Periodic storage of a worker's checkpoints and queued results."""

import time
from collections.abc import Awaitable, Callable, Sequence

import structlog
from nats.aio.client import Client

from bms_estimator.fleet.nats.connection import error_text
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
    """

    def __init__(self, nc: Client, interval_s: float, partitions: int) -> None:
        self._nc, self._interval_s, self._partitions = nc, interval_s, partitions
        self.checkpoint_s: float | None = None

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
        try:
            await action()
        except RETRYABLE_ERRORS as error:
            log.warning(
                "a checkpoint, summary or dead letter could not be stored; trying again",
                partition=lease.number,
                reason=error_text(error),
            )
