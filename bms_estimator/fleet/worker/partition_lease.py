"""Lease of one partition by a worker: takeover, processing of messages, checkpoints, release.

The state depends only on the order of the stream. Therefore the sequence number of the last processed message defines the state.
Messages that were delivered to another worker, or lost in transit, are read from the stream. The stream is also read after
some time without a delivery, because the server does not redeliver messages that it delivered to a worker that has died.

Messages that need no request to the server are processed by the block loop. The task of the lease does everything else: it catches
up with the stream, processes deferred messages one by one, and sends changes of the table of packs. During the last two, the
block loop continues.
"""

import asyncio
import time
from collections.abc import Awaitable, Callable
from contextlib import aclosing
from functools import partial

import structlog
from nats.aio.client import Client
from nats.aio.msg import Msg

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.checkpoint_pointer import CheckpointInfo
from bms_estimator.fleet.nats.connection import RETRY_S, RETRYABLE_ERRORS, error_text
from bms_estimator.fleet.worker.block_loop import SILENCE_S, BlockLoop, DeliveredMessages
from bms_estimator.fleet.worker.block_result import BlockResult, ResultPublisher, merge
from bms_estimator.fleet.worker.block_runner import BlockRunner, Totals
from bms_estimator.fleet.worker.checkpoint.checkpoint_format import UnreadableFormatError
from bms_estimator.fleet.worker.checkpoint.checkpoint_store import CheckpointStore
from bms_estimator.fleet.worker.checkpoint.claims import Claim, FencedError
from bms_estimator.fleet.worker.deferred import Span
from bms_estimator.fleet.worker.partition import Partition
from bms_estimator.fleet.worker.partition_reader import PartitionReader
from bms_estimator.fleet.worker.pinned_consumer import DeliveredMessage, PinnedConsumer
from bms_estimator.fleet.worker.table_in_force import PackLookup, PackSources
from bms_estimator.fleet.worker.takeover import ReplayGuard, restore_partition

IDLE_SILENCE_S = 5.0 * SILENCE_S
"""Interval between two searches while the stream has no further messages [s]."""
_FENCED = (FencedError, UnreadableFormatError)
"""Errors that show that another worker, possibly of another version, has claimed the partition of this worker."""

log = structlog.get_logger(__name__)


class PartitionLease:
    """Partition that this worker has claimed. The worker owns the partition until another worker claims it.

    Args:
        nc: Connection to the tenant's NATS account.
        number: Number of the partition.
        table: Settings and models of the packs.
        checkpoints: Store of the checkpoints.
        inbox: Prefix of the subject for responses (``PinnedConsumer``).
        block_loop: Loop of the worker, which processes the delivered messages that need no request to the server.
        partitions: Number of partitions of the stream.
        sources: Rows of the same table; their changes are sent to the stream. None: changes take effect at once.
        checkpoint_format: Returns the format in which checkpoints are written, which all live workers read.
        is_busy: Returns True while any partition of the worker has received messages that are not processed.

    Attributes:
        totals: Totals of the worker; updated.
        consumer: Consumer of the messages.
        results: Publisher of the results.
        runner: Runner of the messages.
        partition: State of the packs; None while the partition is not taken over.
        claim: Claim of this worker; None while it has none.
        checkpoint_due_s: Monotonic clock at which the next checkpoint is due [s].
        trouble: Text of the present error; empty without one.
        storage_troubles: Texts of the present errors of ``PeriodicStorage``, by kind of data.
        refused_format: Format of the last checkpoint if this worker cannot read it, and therefore refuses the partition;
            otherwise None.
    """

    def __init__(
        self,
        nc: Client,
        number: int,
        table: PackLookup,
        checkpoints: CheckpointStore,
        inbox: str,
        block_loop: BlockLoop,
        totals: Totals,
        *,
        partitions: int,
        checkpoint_format: Callable[[], int],
        is_busy: Callable[[], bool],
        sources: PackSources | None = None,
    ) -> None:
        self.number, self._table, self._sources = number, table, sources
        self._checkpoints, self._checkpoint_format, self._block_loop = checkpoints, checkpoint_format, block_loop
        self.totals = totals
        self._js, self._messages, self._is_busy = nc.jetstream(), PartitionReader(nc, number), is_busy
        self._guard = ReplayGuard(checkpoints.replays, number)
        self.results = ResultPublisher(nc)
        self.runner = BlockRunner(
            number,
            partitions,
            checkpoints.worker,
            block_loop.step_lock,
            self._guard,
            self.results,
            totals,
            save=self.save,
        )
        self.consumer = PinnedConsumer(nc, number, f"{inbox}.{number}")
        self.partition: Partition | None = None
        self.claim: Claim | None = None
        self.trouble, self.checkpoint_due_s, self.storage_troubles = "", 0.0, dict[str, str]()
        self.refused_format: int | None = None
        self._delivered = DeliveredMessages(
            self.consumer, self._guard, self.results, block_loop, self._process_next, self._try
        )
        self._is_search_due = False  # True: the stream must be searched, because no message has arrived
        self._are_changes_due = False  # True: changed rows of the table must be sent
        self._replay_end = 0  # stream sequence number of the last message at the takeover
        self._state_lock = asyncio.Lock()  # held while ``partition`` and ``claim`` change

    @property
    def last_checkpoint(self) -> CheckpointInfo | None:
        """Last checkpoint; None without one."""
        return self.claim.pointer.kept[0] if self.claim and self.claim.pointer.kept else None

    @property
    def is_checkpoint_too_new(self) -> bool:
        """True if a live worker cannot read the last checkpoint."""
        return self.last_checkpoint is not None and self.last_checkpoint.format > self._checkpoint_format()

    @property
    def is_owned(self) -> bool:
        """True if this worker owns the partition as far as it knows."""
        return self.partition is not None and self.claim is not None

    def receive(self, message: Msg) -> None:
        """Process a message or status from the server."""
        if self.consumer.receive(message):
            self._delivered.pin_lapsed = True
            self._delivered.postpone_search()
        self._block_loop.add(self._delivered)

    def check_silence(self) -> None:
        """Request a search of the stream after silence, and a check of deferred packs and of changes of the table.

        The caller calls this method about once a second.
        """
        self._is_search_due |= time.monotonic() >= self._delivered.next_search_s
        self._are_changes_due = True
        self._delivered.wake_up()

    async def run(self) -> None:
        """Process the messages that need requests to the server until cancelled; leave the others to the block loop."""
        delivered = self._delivered
        while True:
            delivered.begin_pass()
            if delivered.pin_lapsed:
                await self._try(self._check_ownership)
            await self.consumer.refill()
            if self.consumer.waiting and not delivered.can_process_next():
                await self._process_delivered(self.consumer.pop())
                delivered.postpone_search()
            elif self._is_search_due and not self.consumer.waiting:
                self._is_search_due = False
                delivered.postpone_search()
                await self._try(self._read_undelivered)
            elif self._are_changes_due:
                self._are_changes_due = False
                with delivered.processed_by_loop():
                    await self._try(self._send_table_changes)
            elif (partition := self.partition) and (due := partition.deferred.next(self._is_due)):
                with delivered.processed_by_loop():
                    if not await self._try(partial(self._process_deferred, partition, *due)):
                        await asyncio.sleep(RETRY_S)
            else:
                await delivered.wait()

    async def save(self) -> None:
        """Write a checkpoint if the state has changed since the last one, or if a live worker cannot read the last one.

        Raises:
            nats.errors.Error: The server rejects it, or does not respond in time; the last checkpoint remains valid.
        """
        async with self._state_lock:
            partition, claim = self.partition, self.claim
            if partition is None or claim is None:
                return
            if (
                self.last_checkpoint
                and self.last_checkpoint.sequence == partition.sequence
                and partition.deferred.is_saved
                and not self.is_checkpoint_too_new
            ):
                return
            # before the snapshot, because a server that has lost its data begins a new stream
            await self._confirm_claim()
            if self.claim is None:
                return
            claim, snapshot, partition.deferred.is_saved = self.claim, partition.snapshot(), True
            try:
                # first, because the next owner does not compute the summaries and dead letters of saved samples again
                await self.results.send_queued()
                file_format = self._checkpoint_format()
                self.claim = await self._checkpoints.write(claim, snapshot, file_format=file_format)
                partition.mark_saved(is_whole=not self.claim.pointer.kept[0].increments)
            except _FENCED as error:
                self._drop_ownership(error)
            except BaseException:
                partition.deferred.is_saved = False
                raise

    async def release(self) -> None:
        """Write a checkpoint and release the partition; ``run`` has ended."""
        try:
            await self.save()
            if self.claim:
                await self._checkpoints.claims.record_release(self.claim)
        except FencedError as error:
            self._drop_ownership(error)
        except RETRYABLE_ERRORS as error:
            log.warning(
                "released without a new checkpoint: the next owner reads the stream from the last one",
                partition=self.number,
                reason=error_text(error),
            )
        try:
            await self.consumer.unpin()
        except RETRYABLE_ERRORS as error:
            log.warning(
                "not released: the server's pin expires after some seconds",
                partition=self.number,
                reason=error_text(error),
            )

    def drop(self) -> None:
        """Drop state, claim and troubles, and add the events in the partition to the totals of the worker."""
        if self.partition:
            self.totals.events.update(self.partition.events)
        self.partition = self.claim = None
        self.storage_troubles.clear()

    def on_settings_changed(self, pack: str) -> None:
        """Handle a changed or new row of the table of packs."""
        if self.partition:
            self.partition.in_force.on_table_changed(pack)
            self._are_changes_due = True
            self._delivered.wake_up()

    async def _process_delivered(self, delivered: DeliveredMessage) -> None:
        """Process the stream up to a delivered message. Return without it if the pin is lost."""
        self._delivered.is_caught_up = False
        while not (await self._try(partial(self._process_up_to, delivered)) and self._delivered.is_caught_up):
            await asyncio.sleep(RETRY_S)
            if self._delivered.pin_lapsed or not self.consumer.has_pin:
                return

    async def _process_up_to(self, delivered: DeliveredMessage) -> None:
        """Process the stream up to a delivered message, after a confirmation of the claim if its pin is new."""
        partition = self.partition
        if delivered.pin != self._delivered.pin or partition is None:
            async with self._state_lock:
                partition = await self._take_over()
            self._delivered.pin = delivered.pin
        # guarded messages are read together, because a request for one of them also returns the following ones
        self._delivered.is_caught_up = await self._catch_up(
            partition, max(delivered.message.sequence, self._guard.end_sequence)
        )

    async def _read_undelivered(self) -> None:
        """Bring the state up to the end of the stream after silence, unless another worker is pinned."""
        if not self.consumer.has_pin and await self.consumer.is_pinned_to_any_worker():
            await self._check_ownership()
            return
        async with self._state_lock:
            partition = await self._take_over()
        if await self._messages.next(partition.sequence + 1):
            await self._catch_up(partition, await self._messages.last_sequence())
        else:
            self._delivered.postpone_search(IDLE_SILENCE_S)

    async def _take_over(self) -> Partition:
        """Claim the partition unless this worker owns it. Return its state, which may be that of an old checkpoint."""
        await self._confirm_claim()
        partition = self.partition
        if partition is None:
            claim = await self._checkpoints.claim(self.number)
            partition = await restore_partition(self._checkpoints, claim, self.number, self._table, self._sources)
            self._replay_end = await self._messages.last_sequence()
            await self._guard.begin(claim, self._replay_end)
            self.partition, self.claim = partition, claim
        last_sequence = await self._messages.last_of_all_partitions()
        if self._guard.end_sequence > last_sequence:  # the server has since lost the replayed stream
            self._guard.end_sequence = 0
        if partition.sequence > last_sequence:
            log.warning(
                "the stream ends before the checkpoint, because it was recreated or has lost its end: reading it from its beginning",
                partition=self.number,
                stream=last_sequence,
                checkpoint=partition.sequence,
            )
            partition.sequence = 0
            partition.deferred.clear()
        return partition

    async def _catch_up(self, partition: Partition, sequence: int) -> bool:
        """Process the stream up to a message. Return False if it ended before, because another worker may own the partition.

        Only the newest reply and estimates of each pack are published.
        """
        if partition.sequence >= sequence:
            return True
        latest: dict[str, BlockResult] = {}
        async with aclosing(self._messages.read(partition.sequence + 1, sequence)) as messages:
            async for message in messages:
                if self._delivered.pin_lapsed or self.partition is not partition:
                    break
                result = await self.runner.process(partition, message)
                latest[message.pack] = merge(latest.get(message.pack), result)
        for result in latest.values() if self.partition is partition else ():
            await self.results.publish(result)
        return self.partition is partition and not self._delivered.pin_lapsed

    def _process_next(self, delivered: DeliveredMessage) -> None:
        """Process a delivered message whose predecessors are all processed."""
        partition = self.partition
        if partition is not None and delivered.message.sequence > partition.sequence:
            self.results.add(self.runner.process_unguarded(partition, delivered.message))

    def _is_due(self, pack: str) -> bool:
        """Return True if a deferred pack is known, and is within its budget or no other pack needs the processor."""
        is_known = self.partition is not None and self.partition.in_force.is_known(pack)
        return is_known and not (self.runner.budget.is_exhausted(pack) and self._is_busy())

    async def _process_deferred(self, partition: Partition, pack: str, span: Span) -> None:
        """Process the next deferred message of a pack."""
        message = await self._messages.next(span.first, pack)
        if message is None or message.sequence > span.last:
            # the stream has dropped the messages; the reply to the edge's next block requests them again
            partition.deferred.advance(pack, span.last)
        else:
            await self.results.publish(await self.runner.process_deferred(partition, message))

    async def _send_table_changes(self) -> None:
        """Send the rows of the table that differ from those in force to the stream.

        Nothing is sent before the end of the replay, because the replay contains the changes that the former owner has sent.
        """
        partition = self.partition
        if partition is None or partition.sequence < self._replay_end:
            return
        for pack in list(partition.in_force.unchecked):
            change = partition.in_force.table_change(pack)
            if change is not None:
                await self._js.publish(subjects.table_change(pack), change)
            partition.in_force.unchecked.discard(pack)

    async def _check_ownership(self) -> None:
        """Check the ownership after the pin has lapsed."""
        async with self._state_lock:
            await self._confirm_claim()
        self._delivered.pin_lapsed = False

    async def _confirm_claim(self) -> None:
        """Confirm this worker's claim, if any; the caller holds ``_state_lock``."""
        if self.claim is None:
            return
        revision = self.claim.revision
        try:
            self.claim = await self._checkpoints.claims.confirm(self.claim)
        except _FENCED as error:
            self._drop_ownership(error)
            return
        if self.partition and revision > self.claim.revision:  # the server has lost its data: its stream begins again
            self.partition.sequence = 0
            self.partition.deferred.clear()

    def _drop_ownership(self, error: Exception) -> None:
        """Drop state and claim, because another worker has claimed the partition."""
        log.warning("fenced out: another worker has taken the partition over", partition=self.number, worker=str(error))
        self.drop()
        self._delivered.reset()
        self.results.clear()  # the owner of the partition computes them from the last checkpoint on

    def _refuse(self, error: UnreadableFormatError) -> None:
        """Refuse the partition, so that this worker releases the lease, and another worker claims the partition."""
        if self.refused_format is None:
            log.error("partition refused and left to other workers", partition=self.number, reason=str(error))
        self.refused_format = error.format

    async def _try(self, action: Callable[[], Awaitable[None]]) -> bool:
        """Return True if ``action`` succeeded; log the error if it failed."""
        try:
            await action()
        except FencedError as error:
            self._drop_ownership(error)
            return False
        except UnreadableFormatError as error:
            self._refuse(error)
            return False
        except RETRYABLE_ERRORS as error:
            if (text := error_text(error)) != self.trouble:
                log.warning("waiting for the server", partition=self.number, reason=text)
            self.trouble = text
            return False
        self.trouble = ""
        return True
