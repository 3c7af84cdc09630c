"""Tasks of one partition: process deferred messages (``deferred``), and send changes of the table of packs to the stream."""

import asyncio
from collections.abc import Callable, Iterable
from functools import partial

from nats.aio.client import Client
from nats.js.errors import NotFoundError

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.connection import RETRY_S
from bms_estimator.fleet.worker.block_loop import Attempt
from bms_estimator.fleet.worker.block_result import ResultPublisher
from bms_estimator.fleet.worker.block_runner import BlockRunner
from bms_estimator.fleet.worker.deferred import Span
from bms_estimator.fleet.worker.partition import Partition
from bms_estimator.fleet.worker.pinned_consumer import discard_forged_data


class DeferredReader:
    """Task that reads and processes the deferred messages of one partition.

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
        """Process deferred messages until cancelled, one message of each pack in turn."""
        while True:
            self._wake_up.clear()
            while (partition := self._owned_partition()) and (due := partition.deferred.next(self._is_due)):
                if not await self._attempt(partial(self._process, partition, *due)):
                    await asyncio.sleep(RETRY_S)
            await self._wake_up.wait()

    def _is_due(self, pack: str) -> bool:
        """Return True if a deferred pack is known, and is within its budget or no other pack needs the processor."""
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
        data, sequence = discard_forged_data(message.subject or "", message.data or b""), message.seq or 0
        if sequence > span.last:  # the stream has dropped the deferred messages
            partition.deferred.advance(pack, span.last)
            return
        process_message = partial(
            partition.process_deferred, received_s=int(message.time.timestamp()) if message.time else None
        )
        self._runner.count_block(data)
        await self._results.publish(await self._runner.run(pack, data, sequence, process_message))


class TableChangeSender:
    """Task that sends changed rows of the table of packs to the stream.

    A row has changed if it differs from the row with which the partition processes its blocks (``table_in_force``).

    Args:
        nc: Connection to the tenant's NATS account.
        owned_partition: Returns the partition; None while this worker does not own it.
        attempt: Runs an action and handles its errors.
    """

    def __init__(self, nc: Client, owned_partition: Callable[[], Partition | None], attempt: Attempt) -> None:
        self._nc, self._owned_partition, self._attempt = nc, owned_partition, attempt
        self._packs = set[str]()  # packs whose rows may differ from those in force
        self._replay_end = 0
        self._wake_up = asyncio.Event()

    def begin(self, packs: Iterable[str], replay_end: int) -> None:
        """Replace the packs to check after a takeover, because the former owner may not have sent the last changes.

        Args:
            packs: Names of all packs with rows in force.
            replay_end: Stream sequence number of the last message of the partition at the takeover. Nothing is sent before the
                replay has reached it, because the replay contains the changes that the former owner has sent.
        """
        self._packs, self._replay_end = set(packs), replay_end

    def add(self, pack: str) -> None:
        """Check the row of a pack, and send it if it differs from the one in force."""
        self._packs.add(pack)
        self.wake_up()

    def wake_up(self) -> None:
        """Let ``run`` check again, for example because the replay has ended."""
        self._wake_up.set()

    async def run(self) -> None:
        """Send changes until cancelled."""
        while True:
            self._wake_up.clear()
            while self._packs and (partition := self._owned_partition()) and partition.sequence >= self._replay_end:
                pack = next(iter(self._packs))
                if await self._attempt(partial(self._send, partition, pack)):
                    self._packs.discard(pack)
                else:
                    await asyncio.sleep(RETRY_S)
            await self._wake_up.wait()

    async def _send(self, partition: Partition, pack: str) -> None:
        """Send the row of a pack if it differs from the one in force."""
        change = partition.in_force.table_change(pack)
        if change is not None:
            await self._nc.jetstream().publish(subjects.table_change(pack), change)
