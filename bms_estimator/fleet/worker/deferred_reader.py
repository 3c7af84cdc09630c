"""Reading of the deferred messages of one partition from the stream (``deferred``)."""

import asyncio
from collections.abc import Callable
from functools import partial

from nats.aio.client import Client
from nats.js.errors import NotFoundError

from bms_estimator.edge import subjects
from bms_estimator.fleet.worker.block_runner import BlockRunner
from bms_estimator.fleet.worker.deferred import Span
from bms_estimator.fleet.worker.partition import Partition
from bms_estimator.fleet.worker.raw_messages import trusted_data
from bms_estimator.fleet.worker.result_publisher import ResultPublisher
from bms_estimator.fleet.worker.retry import RETRY_S, Attempt


class DeferredReader:
    """Reader of the deferred messages of one partition.

    Args:
        nc: Connection to the tenant's NATS account.
        owned_partition: Returns the partition; None while this worker does not own it.
        runner: Runner of the messages.
        results: Publisher of the results.
        is_busy: Returns True while any partition of the worker has received messages that are not processed.
        attempt: Runs an action and handles its errors.
    """

    def __init__(
        self,
        nc: Client,
        owned_partition: Callable[[], Partition | None],
        runner: BlockRunner,
        results: ResultPublisher,
        *,
        is_busy: Callable[[], bool],
        attempt: Attempt,
    ) -> None:
        self._nc, self._owned_partition, self._runner, self._results = nc, owned_partition, runner, results
        self._is_busy, self._attempt = is_busy, attempt
        self._wake_up = asyncio.Event()

    def wake_up(self) -> None:
        """Check whether a deferred pack is due."""
        self._wake_up.set()

    async def run(self) -> None:
        """Process deferred messages until cancelled, one of each pack at a time."""
        while True:
            self._wake_up.clear()
            while (partition := self._owned_partition()) and (due := partition.deferred.next(self._is_due)):
                if not await self._attempt(partial(self._process, partition, *due)):
                    await asyncio.sleep(RETRY_S)
            await self._wake_up.wait()

    def _is_due(self, pack: str) -> bool:
        """Return True if a deferred pack is known and within its budget, or if no other pack needs the processor."""
        partition = self._owned_partition()
        is_known = partition is not None and partition.in_force.is_known(pack)
        return is_known and not (self._runner.budget.is_exhausted(pack) and self._is_busy())

    async def _process(self, partition: Partition, pack: str, span: Span) -> None:
        """Process the next deferred message of a pack."""
        subject = subjects.stored(partition.number, pack)
        try:
            message = await self._nc.jetstream().get_msg(subjects.RAW_STREAM, span.first, subject, next=True)
        except NotFoundError:
            # the stream has dropped the messages; the reply to the edge's next block requests them again
            partition.deferred.advance(pack, span.last)
            return
        data, sequence = trusted_data(message.subject or "", message.data or b""), message.seq or 0
        if sequence > span.last:  # the stream has dropped the deferred messages
            partition.deferred.advance(pack, span.last)
            return
        take = partial(partition.take_deferred, received_s=int(message.time.timestamp()) if message.time else None)
        self._runner.count_block(data)
        await self._results.publish(await self._runner.run(pack, data, sequence, take))
