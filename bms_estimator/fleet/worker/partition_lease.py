"""Lease of one partition by a worker: take-over, processing of messages, checkpoints, release.

The state depends only on the order of the stream. Therefore the sequence number of the last processed message defines the state.
Messages that were delivered to another worker, or lost in transit, are read from the stream. The stream is also read after
some time without a delivery, because the server does not redeliver messages that it delivered to a worker that has died.
"""

import asyncio
import time
from collections.abc import Awaitable, Callable, Mapping
from contextlib import aclosing
from functools import partial

import structlog
from nats.aio.client import Client
from nats.aio.msg import Msg
from nats.js.errors import NotFoundError

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.checkpoint_pointer import CheckpointInfo
from bms_estimator.fleet.nats.connection import error_text
from bms_estimator.fleet.nats.stored_messages import read_messages
from bms_estimator.fleet.nats.stream_reader import StoredMessage
from bms_estimator.fleet.packs.table_change import trusted_data
from bms_estimator.fleet.worker.block_loop import BlockLoop
from bms_estimator.fleet.worker.block_runner import BlockRunner
from bms_estimator.fleet.worker.checkpoint.checkpoint_format import UnreadableFormatError
from bms_estimator.fleet.worker.checkpoint.checkpoint_store import CheckpointStore
from bms_estimator.fleet.worker.checkpoint.claims import Claim, FencedError
from bms_estimator.fleet.worker.deferred_reader import DeferredReader
from bms_estimator.fleet.worker.partition import BlockResult, PackLookup, PackSources, Partition
from bms_estimator.fleet.worker.partition_restore import restore_partition
from bms_estimator.fleet.worker.pinned_consumer import DeliveredMessage, PinnedConsumer
from bms_estimator.fleet.worker.replay_guard import ReplayGuard
from bms_estimator.fleet.worker.result_publisher import ResultPublisher, merge
from bms_estimator.fleet.worker.retry import RETRY_S, RETRYABLE_ERRORS
from bms_estimator.fleet.worker.table_change_sender import TableChangeSender
from bms_estimator.process.tasks import until_first_ends

SILENCE_S = 3.0
"""Time without a delivery after which the stream is searched for further messages [s]. Another worker releases the partition in
less time."""
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
        consumer: Consumer of the messages.
        results: Publisher of the results.
        runner: Runner of the messages, with the counters of this lease.
        partition: State of the packs; None while the partition is not taken over.
        restored_counters: Counters of the partition at its claim.
        claim: Claim of this worker; None while it has none.
        checkpoint_due_s: Monotonic clock at which the next checkpoint is due [s].
        trouble: Text of the present error; empty without one.
        refused_format: Format of the unreadable last checkpoint, because of which the partition is left to other workers;
            None: the partition is not refused.
    """

    def __init__(
        self,
        nc: Client,
        number: int,
        table: PackLookup,
        checkpoints: CheckpointStore,
        inbox: str,
        block_loop: BlockLoop,
        *,
        partitions: int,
        checkpoint_format: Callable[[], int],
        is_busy: Callable[[], bool],
        sources: PackSources | None = None,
    ) -> None:
        self._nc, self.number, self._table, self._sources, self._partitions = nc, number, table, sources, partitions
        self._checkpoints, self._checkpoint_format, self._block_loop = checkpoints, checkpoint_format, block_loop
        self._guard = ReplayGuard(checkpoints.replays, number)
        self._changes = TableChangeSender(nc, lambda: self.partition, self._try)
        self.results = ResultPublisher(nc)
        self.runner = BlockRunner(
            number, checkpoints.worker, block_loop.step_lock, self._guard, self.results, self._changes, self.save
        )
        self._deferred = DeferredReader(
            nc, lambda: self.partition, self.runner, self.results, is_busy=is_busy, attempt=self._try
        )
        self.consumer = PinnedConsumer(nc, number, f"{inbox}.{number}")
        self.partition: Partition | None = None
        self.restored_counters: Mapping[str, int] = {}
        self.claim: Claim | None = None
        self.trouble, self.checkpoint_due_s = "", 0.0
        self.refused_format: int | None = None
        self._pin = 0  # number of the pin under which the claim was last confirmed
        self._is_gapless = False  # the state includes all messages before the last delivered one
        self._pin_lapsed = False  # the ownership must be checked, because the pin has ended
        self._silent = False  # the stream must be searched, because no message has arrived
        self._next_search_s = time.monotonic() + SILENCE_S  # monotonic clock of the next search of the stream
        self._wake_up = asyncio.Event()
        self._is_idle = (
            False  # the task of this lease waits for ``_wake_up``, so that the block loop may process messages
        )
        self._unpublished: list[BlockResult] = []
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
            self._pin_lapsed, self._next_search_s = True, time.monotonic() + SILENCE_S
        self._block_loop.add(self)

    def process_next(self) -> bool:
        """Process the next delivered message, or wake up the task of this lease if a request to the server is necessary.

        Returns:
            True if the next call can process a message.
        """
        partition = self.partition
        if partition is None or not (self._is_idle and self._is_next_gapless()):
            if self.consumer.waiting or self._pin_lapsed:
                self._wake_up.set()
            return False
        delivered = self.consumer.pop()
        self._next_search_s = time.monotonic() + SILENCE_S
        if delivered.sequence > partition.sequence:
            self._unpublished.append(self._process_gapless(partition, delivered))
        return self._is_next_gapless()

    def _is_next_gapless(self) -> bool:
        """Return True if a message waits, the state includes all messages before it, and it needs no request to the server."""
        if not self.consumer.waiting or not self._is_gapless or self._pin_lapsed:
            return False
        delivered = self.consumer.waiting[0]
        return delivered.follows and delivered.pin == self._pin and not self._guard.is_guarded(delivered.sequence)

    def _process_gapless(self, partition: Partition, delivered: DeliveredMessage) -> BlockResult:
        """Process or defer a message that needs no request to the server."""
        pack, data, sequence = delivered.pack, delivered.data, delivered.sequence
        result = self._reject_or_defer(partition, pack, sequence)
        if result is None:
            take = partial(partition.take, received_s=delivered.received_s)
            result = self.runner.run_unguarded(pack, data, sequence, take)
            self._count(partition, pack, data)
        return result

    async def publish(self) -> None:
        """Publish the results of ``process_next``, and request further messages."""
        results, self._unpublished = self._unpublished, []
        if not results:
            return

        async def publish_all() -> None:
            for result in results:
                await self.results.publish(result)
            await self.consumer.request_taken()

        if not await self._try(publish_all):
            self._is_gapless = False

    def check_silence(self) -> None:
        """Request a search of the stream after silence, and a check of deferred packs and of changes of the table.

        The caller calls this method about once a second.
        """
        if time.monotonic() >= self._next_search_s:
            self._silent = True
            self._wake_up.set()
        self._deferred.wake_up()
        self._changes.wake_up()

    async def run(self) -> None:
        """Process messages until cancelled."""
        await until_first_ends(self._process_messages(), self._deferred.run(), self._changes.run())

    async def _process_messages(self) -> None:
        """Process the messages that need requests to the server; leave the others to the block loop."""
        while True:
            self._wake_up.clear()
            if self._pin_lapsed:
                await self._try(self._check_ownership)
            await self.consumer.request_taken()
            if self.consumer.waiting and not self._is_next_gapless():
                await self._process_delivered(self.consumer.pop())
                self._next_search_s = time.monotonic() + SILENCE_S
            elif self._silent and not self.consumer.waiting:
                self._silent, self._next_search_s = False, time.monotonic() + SILENCE_S
                await self._try(self._read_undelivered)
            else:
                await self._wait()

    async def _wait(self) -> None:
        """Let the block loop process messages until ``_wake_up`` is set."""
        self._is_idle = True
        if self.consumer.waiting:
            self._block_loop.add(self)
        try:
            await self._wake_up.wait()
        finally:
            self._is_idle = False

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
            snapshot, partition.deferred.is_saved = partition.snapshot(), True
            try:
                # Summaries and dead letters are sent first, because the next owner does not compute those of saved samples
                # again.
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
                await self._checkpoints.claims.end(self.claim)
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

    def settings_changed(self, pack: str) -> None:
        """Handle a changed or new row of the table of packs."""
        if self.partition:
            if pack not in self.partition.in_force:  # a row in force changes only by a message of the stream
                self.partition.settings_changed(pack)
            self._changes.add(pack)
            self._deferred.wake_up()

    async def _process_delivered(self, delivered: DeliveredMessage) -> None:
        """Process a delivered message after all earlier ones. Return without it if the pin is lost."""
        while not await self._try(lambda: self._process_before(delivered)):
            await asyncio.sleep(RETRY_S)
            if not self.consumer.has_pin:
                self._is_gapless = False
                return
        partition = self.partition
        if partition is None or delivered.sequence <= partition.sequence:
            return
        if not await self._try(partial(self._take_delivered, partition, delivered)):
            self._is_gapless = False

    async def _take_delivered(self, partition: Partition, delivered: DeliveredMessage) -> None:
        """Process a delivered message whose predecessors are all processed."""
        await self.results.publish(await self._take_or_defer(partition, delivered.pack, delivered))

    async def _process_before(self, delivered: DeliveredMessage) -> None:
        """Bring the state up to the message before a delivered one."""
        partition = self.partition
        if delivered.pin != self._pin or partition is None:
            self._is_gapless = False
            async with self._state_lock:
                partition = await self._take_over()
            self._pin = delivered.pin
        if not (self._is_gapless and delivered.follows):
            self._is_gapless = False
            await self._catch_up(partition, delivered.sequence)
            self._is_gapless = True

    async def _read_undelivered(self) -> None:
        """Bring the state up to the end of the stream after silence, unless another worker is pinned."""
        if not self.consumer.has_pin and await self.consumer.is_pinned_to_any_worker():
            await self._check_ownership()
            return
        async with self._state_lock:
            partition = await self._take_over()
        js, subject = self._nc.jetstream(), subjects.stored(self.number)
        try:
            await js.get_msg(subjects.RAW_STREAM, partition.sequence + 1, subject, next=True)
        except NotFoundError:
            self._next_search_s = time.monotonic() + IDLE_SILENCE_S
        else:
            await self._catch_up(partition, await self._last_partition_sequence())

    async def _take_over(self) -> Partition:
        """Claim the partition unless this worker owns it. Return its state, which may be that of an old checkpoint."""
        await self._confirm_claim()
        partition = self.partition
        if partition is None:
            claim = await self._checkpoints.claim(self.number)
            partition = await restore_partition(self._checkpoints, claim, self.number, self._table, self._sources)
            replay_end = await self._last_partition_sequence()
            await self._guard.begin(claim, replay_end)
            self.partition, self.claim, self.restored_counters = partition, claim, partition.counters
            self._changes.begin(partition.in_force, replay_end)
            self._deferred.wake_up()
        last_sequence = (await self._nc.jetstream().stream_info(subjects.RAW_STREAM)).state.last_seq
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

    async def _last_partition_sequence(self) -> int:
        """Return the sequence number of the last message of the partition; 0 without a message."""
        js, subject = self._nc.jetstream(), subjects.stored(self.number)
        try:
            return (await js.get_last_msg(subjects.RAW_STREAM, subject)).seq or 0
        except NotFoundError:
            return 0

    async def _catch_up(self, partition: Partition, sequence: int) -> None:
        """Process the stream up to a message. Of each pack, only the newest reply and the newest estimates are published."""
        if partition.sequence >= sequence:
            return
        latest: dict[str, BlockResult] = {}
        subject = subjects.stored(self.number)
        messages = read_messages(self._nc, subjects.RAW_STREAM, subject, partition.sequence + 1, sequence)
        async with aclosing(messages):
            async for message in messages:
                pack = message.subject.rpartition(".")[2]
                trusted = message._replace(data=trusted_data(message.subject, message.data))
                result = await self._take_or_defer(partition, pack, trusted)
                latest[pack] = merge(latest.get(pack), result)
        for result in latest.values():
            await self.results.publish(result)

    async def _take_or_defer(
        self, partition: Partition, pack: str, message: DeliveredMessage | StoredMessage
    ) -> BlockResult:
        """Process a message, or defer it if its pack has exhausted its budget or has deferred messages."""
        data, sequence = message.data, message.sequence
        result = self._reject_or_defer(partition, pack, sequence)
        if result is not None:
            await asyncio.sleep(0)  # lets the event loop send heartbeats while many messages are deferred
            return result
        result = await self.runner.run(pack, data, sequence, partial(partition.take, received_s=message.received_s))
        self._count(partition, pack, data)
        return result

    def _reject_or_defer(self, partition: Partition, pack: str, sequence: int) -> BlockResult | None:
        """Return None if a message can be processed now. Otherwise reject or defer it."""
        if subjects.partition_of(pack, self._partitions) != self.number:
            return partition.reject_misplaced(pack, sequence)
        if pack not in partition.deferred and not self.runner.budget.is_exhausted(pack):
            return None
        self._deferred.wake_up()
        return partition.defer(pack, sequence)

    def _count(self, partition: Partition, pack: str, data: bytes) -> None:
        """Count a message that was processed and not deferred."""
        if pack not in partition.deferred:
            self.runner.count_block(data)

    async def _check_ownership(self) -> None:
        """Check the ownership after the pin has lapsed."""
        async with self._state_lock:
            await self._confirm_claim()
        self._pin_lapsed = False

    async def _confirm_claim(self) -> None:
        """Confirm this worker's claim, if any; the caller holds ``_state_lock``."""
        if self.claim:
            try:
                self.claim = await self._checkpoints.claims.confirm(self.claim)
            except _FENCED as error:
                self._drop_ownership(error)

    def _drop_ownership(self, error: Exception) -> None:
        """Drop state and claim, because another worker has claimed the partition."""
        log.warning("fenced out: another worker has taken the partition over", partition=self.number, worker=str(error))
        self.partition = self.claim = None
        self._pin, self._is_gapless = 0, False
        self.results.clear()  # the owner of the partition computes them from the last checkpoint on

    def _refuse(self, error: UnreadableFormatError) -> None:
        """Leave the partition to other workers. The worker that holds this lease then releases it."""
        if self.refused_format is None:
            log.error("partition refused and left to other workers", partition=self.number, reason=str(error))
        self.refused_format = error.found

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
