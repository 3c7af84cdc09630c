"""Lease of one partition by a worker: take-over, processing of messages, checkpoints, release.

The state depends only on the order of the stream. Therefore the sequence number of the last processed message defines the state.
Messages that were delivered to another worker, or lost in transit, are read from the stream. The stream is also read after
some time without a delivery, because the server does not redeliver messages that it delivered to a worker that has died.
"""

import asyncio
import time
from collections import deque
from collections.abc import Awaitable, Callable
from contextlib import aclosing
from functools import partial
from itertools import islice

import structlog
from nats.aio.client import Client
from nats.aio.msg import Msg
from nats.errors import Error as NatsError
from nats.js.errors import NotFoundError

from bms_estimator.edge import subjects
from bms_estimator.edge.block import peek_header
from bms_estimator.fleet.nats.connection import error_text
from bms_estimator.fleet.nats.dead_letters import DeadLetter
from bms_estimator.fleet.nats.stored_messages import read_messages
from bms_estimator.fleet.nats.stream_reader import StoredMessage, StreamError
from bms_estimator.fleet.packs.table_change import is_change, trusted_data
from bms_estimator.fleet.worker.checkpoint_format import UnreadableFormatError
from bms_estimator.fleet.worker.checkpoint_store import CheckpointInfo, CheckpointStore, Claim, FencedError
from bms_estimator.fleet.worker.cpu_budget import CpuBudget
from bms_estimator.fleet.worker.deferred import Span
from bms_estimator.fleet.worker.partition import INTERNAL_ERROR, BlockResult, PackLookup, PackSources, Partition
from bms_estimator.fleet.worker.pinned_consumer import DeliveredMessage, PinnedConsumer
from bms_estimator.fleet.worker.replay_guard import ReplayGuard
from bms_estimator.process.tasks import until_first_ends

RETRY_S = 0.5
"""Retry interval of server requests [s]."""
SILENCE_S = 3.0
"""Time without a delivery after which the stream is searched for further messages [s]. It exceeds the time in
which another worker releases the partition."""
IDLE_SILENCE_S = 5.0 * SILENCE_S
"""Interval between two searches while the stream has no new messages [s]."""
MAX_PENDING_SUMMARIES = 128
"""Maximum number of published summaries that wait for the server's acknowledgment."""
RETRYABLE_ERRORS = (NatsError, TimeoutError, StreamError)
"""Errors of the connection or the server after which a request is repeated."""
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
        step_lock: Lock of the worker, held while a block is estimated. The event loop can send requests and heartbeats between
            two blocks.
        partitions: Number of partitions of the stream.
        sources: Rows of the same table; their changes are sent to the stream. None: changes take effect at once.
        checkpoint_format: Returns the format in which checkpoints are written, which all live workers read.
        is_busy: Returns True while any partition of the worker has received messages that are not processed.

    Attributes:
        consumer: Consumer of the messages.
        partition: State of the packs; None while the partition is not taken over.
        claim: Claim of this worker; None while it has none.
        waiting_summaries: Summaries that the server has not acknowledged yet: (message id, pack, row).
        waiting_dead_letters: Dead letters that the server has not acknowledged yet.
        dead_packs: Reason of the last dead letter of each pack, since the claim.
        lag_s: Largest lag since it was last reset to None [s].
        blocks, samples: Number of blocks and samples processed by this lease.
        faults: Number of blocks skipped because of an internal error.
        dead_letters: Number of dead letters.
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
        step_lock: asyncio.Lock,
        *,
        partitions: int,
        checkpoint_format: Callable[[], int],
        is_busy: Callable[[], bool],
        sources: PackSources | None = None,
    ) -> None:
        self._sources = sources
        self._changed_packs = set[str]()  # packs whose rows may differ from those in force
        self._partitions, self._is_busy, self._budget = partitions, is_busy, CpuBudget()
        self._checkpoint_format = checkpoint_format
        self._nc, self.number, self._table, self._checkpoints = nc, number, table, checkpoints
        self._step_lock = step_lock
        self._guard = ReplayGuard(checkpoints, number)
        self.consumer = PinnedConsumer(nc, number, f"{inbox}.{number}")
        self.partition: Partition | None = None
        self.claim: Claim | None = None
        self.waiting_summaries: deque[tuple[str, str, bytes]] = deque()
        self.waiting_dead_letters: deque[DeadLetter] = deque()
        self.dead_packs: dict[str, str] = {}
        self.lag_s: float | None = None
        self.blocks = self.samples = self.faults = self.dead_letters = 0
        self.trouble, self.checkpoint_due_s = "", 0.0
        self.refused_format: int | None = None
        self._pin = 0  # number of the pin under which the claim was last confirmed
        self._is_gapless = False  # the state includes all messages before the last delivered one
        self._pin_lapsed = False  # the ownership must be checked, because the pin has ended
        self._silent = False  # the stream must be searched, because no message has arrived
        self._next_search_s = time.monotonic() + SILENCE_S  # monotonic clock of the next search of the stream
        self._wake_up, self._wake_up_deferred = asyncio.Event(), asyncio.Event()
        self._wake_up_changes = asyncio.Event()
        self._replay_end = 0  # sequence number of the last message of the partition at the claim
        self._state_lock = asyncio.Lock()  # held while ``partition`` and ``claim`` change
        self._summaries_lock = asyncio.Lock()

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
        self._wake_up.set()

    def check_silence(self) -> None:
        """Request a search of the stream after silence, and a check of deferred packs. Call it about once a second."""
        if time.monotonic() >= self._next_search_s:
            self._silent = True
            self._wake_up.set()
        self._wake_up_deferred.set()
        self._wake_up_changes.set()

    async def run(self) -> None:
        """Process messages until cancelled."""
        await until_first_ends(self._process_messages(), self._process_deferred(), self._send_table_changes())

    async def _process_messages(self) -> None:
        while True:
            self._wake_up.clear()
            if self._pin_lapsed:
                await self._try(self._check_ownership)
            delivered = await self.consumer.take()
            if delivered is not None:
                await self._process_delivered(delivered)
                self._next_search_s = time.monotonic() + SILENCE_S
            elif self._silent:
                self._silent, self._next_search_s = False, time.monotonic() + SILENCE_S
                await self._try(self._read_undelivered)
            else:
                await self._wake_up.wait()

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
                await self.send_results()
                file_format = self._checkpoint_format()
                chunks = snapshot.chunks(file_format)
                self.claim = await self._checkpoints.write(claim, snapshot.sequence, chunks, file_format=file_format)
                partition.mark_saved()
            except _FENCED as error:
                self._drop_ownership(error)
            except BaseException:
                partition.deferred.is_saved = False
                raise

    async def send_results(self) -> None:
        """Publish the waiting summaries and dead letters, and await the server's acknowledgment.

        Raises:
            nats.errors.Error: Some were not acknowledged; they remain in ``waiting_summaries`` or
                ``waiting_dead_letters``.
        """
        js = self._nc.jetstream()

        async def send(message_id: str, pack: str, row: bytes) -> None:
            await js.publish(subjects.hours(pack), row, headers={"Nats-Msg-Id": message_id})

        async with self._summaries_lock:
            while self.waiting_summaries:
                rows = list(islice(self.waiting_summaries, MAX_PENDING_SUMMARIES))
                await asyncio.gather(*(send(*row) for row in rows))
                for row in rows:  # the queue was cleared meanwhile if the ownership was lost
                    if self.waiting_summaries and self.waiting_summaries[0] is row:
                        self.waiting_summaries.popleft()
            while self.waiting_dead_letters:
                letter = self.waiting_dead_letters[0]
                await js.publish(letter.subject, letter.data, headers=letter.headers())
                if self.waiting_dead_letters and self.waiting_dead_letters[0] is letter:
                    self.waiting_dead_letters.popleft()

    async def release(self) -> None:
        """Write a checkpoint and release the partition; ``run`` has ended."""
        try:
            await self.save()
            if self.claim:
                await self._checkpoints.end_claim(self.claim)
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
            if pack not in self.partition.in_force:
                self.partition.settings_changed(pack)
            self._changed_packs.add(pack)
            self._wake_up_changes.set()
            self._wake_up_deferred.set()

    async def _send_table_changes(self) -> None:
        """Send changes of the table to the stream until cancelled.

        After a takeover this begins at the end of the replay, which contains the changes that the former owner has sent.
        """
        while True:
            self._wake_up_changes.clear()
            while self._changed_packs and self.partition and self.partition.sequence >= self._replay_end:
                pack = next(iter(self._changed_packs))
                if await self._try(partial(self._send_table_change, self.partition, pack)):
                    self._changed_packs.discard(pack)
                else:
                    await asyncio.sleep(RETRY_S)
            await self._wake_up_changes.wait()

    async def _send_table_change(self, partition: Partition, pack: str) -> None:
        """Send the row of a pack to the stream if the row differs from the one in force."""
        change = partition.table_change(pack)
        if change is not None:
            await self._nc.jetstream().publish(subjects.table_change(pack), change)

    async def _process_deferred(self) -> None:
        """Process deferred messages until cancelled, one of each pack at a time."""
        while True:
            self._wake_up_deferred.clear()
            while self.partition and (due := self.partition.deferred.next(self._is_due)):
                if not await self._try(partial(self._take_deferred, self.partition, *due)):
                    await asyncio.sleep(RETRY_S)
            await self._wake_up_deferred.wait()

    def _is_due(self, pack: str) -> bool:
        """Return True if a deferred pack is known and within its budget, or if no other pack needs the processor."""
        is_known = self.partition is not None and self.partition.is_known(pack)
        return is_known and not (self._budget.is_exhausted(pack) and self._is_busy())

    async def _take_deferred(self, partition: Partition, pack: str, span: Span) -> None:
        """Process the next deferred message of a pack."""
        js, subject = self._nc.jetstream(), subjects.stored(self.number, pack)
        try:
            message = await js.get_msg(subjects.RAW_STREAM, span.first, subject, next=True)
        except (
            NotFoundError
        ):  # the stream has dropped the messages; the reply to the edge's next block requests them again
            partition.deferred.advance(pack, span.last)
            return
        data, sequence = trusted_data(message.subject or "", message.data or b""), message.seq or 0
        if sequence > span.last:  # the stream has dropped the deferred messages
            partition.deferred.advance(pack, span.last)
            return
        take = partial(partition.take_deferred, received_s=int(message.time.timestamp()) if message.time else None)
        self._count_block(data)
        await self._publish(await self._step(pack, data, sequence, take))

    async def _process_delivered(self, delivered: DeliveredMessage) -> None:
        """Process a delivered message after all earlier ones; return when that is done or the pin is lost."""
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
        await self._publish(await self._take_or_defer(partition, delivered.pack, delivered))

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
        """Claim the partition if necessary and return its state, possibly of an old checkpoint."""
        await self._confirm_claim()
        partition = self.partition
        if partition is None:
            claim = await self._checkpoints.claim(self.number)
            partition = await self._restore(claim)
            self._replay_end = await self._last_partition_sequence()
            await self._guard.begin(claim, self._replay_end)
            self.partition, self.claim = partition, claim
            self._changed_packs = set(partition.in_force)  # the former owner may not have sent the last changes
            self._wake_up_deferred.set()
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

    async def _restore(self, claim: Claim) -> Partition:
        """Return the partition of the newest usable checkpoint; an empty one without a checkpoint.

        Raises:
            UnreadableFormatError: The newest intact checkpoint has a format that this version cannot read.
        """
        async with aclosing(self._checkpoints.load(claim)) as checkpoints:
            async for checkpoint, data in checkpoints:
                try:
                    partition = Partition.restore(self.number, self._table, data, sources=self._sources)
                except UnreadableFormatError:  # an earlier checkpoint, or none, would lose what was learned
                    raise
                except ValueError as error:
                    log.warning(
                        "a checkpoint cannot be used: continuing from an earlier one, or from the stream",
                        partition=self.number,
                        object=checkpoint.object,
                        reason=str(error),
                    )
                else:
                    log.info("taken over", partition=self.number, sequence=checkpoint.sequence, bytes=len(data))
                    return partition
        log.info("taken over without a checkpoint: the stream is read from its beginning", partition=self.number)
        return Partition(self.number, self._table, sources=self._sources)

    async def _catch_up(self, partition: Partition, sequence: int) -> None:
        """Process the stream up to a message. Only the last messages of each pack are published."""
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
                latest[pack] = _merge(latest.get(pack), result)
        for result in latest.values():
            await self._publish(result)

    async def _take_or_defer(
        self, partition: Partition, pack: str, message: DeliveredMessage | StoredMessage
    ) -> BlockResult:
        """Process a message, or defer it if its pack has exhausted its budget or has deferred messages."""
        data, sequence = message.data, message.sequence
        if subjects.partition_of(pack, self._partitions) != self.number:
            return partition.reject_misplaced(pack, sequence)
        if pack in partition.deferred or self._budget.is_exhausted(pack):
            await asyncio.sleep(0)  # lets the event loop send heartbeats while many messages are deferred
            partition.defer(pack, sequence)
            self._wake_up_deferred.set()
            return BlockResult(pack)
        result = await self._step(pack, data, sequence, partial(partition.take, received_s=message.received_s))
        if pack not in partition.deferred:
            self._count_block(data)
        return result

    async def _step(self, pack: str, data: bytes, sequence: int, take: Callable[..., BlockResult]) -> BlockResult:
        """Process a message while no other block is processed, and charge the processor time to its pack."""
        async with self._step_lock:
            await asyncio.sleep(0)  # lets the event loop send heartbeats between two blocks
            is_lethal = await self._guard.is_lethal(sequence)
            begin_s = time.thread_time()
            try:
                result = take(pack, data, sequence, is_lethal=is_lethal)
            except Exception:  # an internal error with one pack, which would otherwise end one worker after another
                log.exception("a block is skipped", partition=self.number, pack=pack, sequence=sequence)
                result = BlockResult(pack, failed=1, dead=INTERNAL_ERROR)
            self._budget.charge(pack, time.thread_time() - begin_s)
            self._record_result(result)
            if result.dead:
                self._record_dead_letter(DeadLetter(pack, sequence, result.dead, self._checkpoints.worker, data))
            if is_change(data):  # the table may have changed again since this change was sent
                self._changed_packs.add(pack)
                self._wake_up_changes.set()
            await self._guard.end_block(sequence)
        if is_lethal:
            await self.save()  # the next owner must not meet the block again
        return result

    def _record_dead_letter(self, letter: DeadLetter) -> None:
        self.dead_letters += 1
        self.dead_packs[letter.pack] = letter.reason
        self.waiting_dead_letters.append(letter)

    def _count_block(self, data: bytes) -> None:
        """Count a block and its samples, and update the lag."""
        if is_change(data):
            return
        samples, arrival_s = peek_header(data)
        self.blocks += 1
        self.samples += samples
        self.lag_s = max(self.lag_s or 0.0, time.time() - arrival_s)

    def _record_result(self, result: BlockResult) -> None:
        self.faults += result.failed
        self.waiting_summaries.extend((message_id, result.pack, row) for message_id, row in result.hours)

    async def _publish(self, result: BlockResult) -> None:
        """Publish reply and estimates of a result. Without a connection they are dropped, because later ones replace them."""
        if not self._nc.is_connected:
            return
        if result.reply is not None:
            await self._nc.publish(subjects.block_request(result.pack), result.reply.model_dump_json().encode())
        for topic, payload in (("state", result.state), ("parameters", result.parameters)):
            if payload is not None:
                await self._nc.publish(subjects.published(result.pack, topic), payload)

    async def _check_ownership(self) -> None:
        """Check the ownership after the pin has lapsed."""
        async with self._state_lock:
            await self._confirm_claim()
        self._pin_lapsed = False

    async def _confirm_claim(self) -> None:
        """Confirm this worker's claim, if any; the caller holds ``_state_lock``."""
        if self.claim:
            try:
                self.claim = await self._checkpoints.confirm_claim(self.claim)
            except _FENCED as error:
                self._drop_ownership(error)

    def _drop_ownership(self, error: Exception) -> None:
        """Drop state and claim, because another worker has claimed the partition."""
        log.warning("fenced out: another worker has taken the partition over", partition=self.number, worker=str(error))
        self.partition = self.claim = None
        self._pin, self._is_gapless = 0, False
        self.dead_packs.clear()  # an erasure claims the partition to remove its packs from the memory, too
        self.waiting_dead_letters.clear()
        self.waiting_summaries.clear()  # the owner of the partition computes them from the last checkpoint on

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


def _merge(before: BlockResult | None, result: BlockResult) -> BlockResult:
    """Merge two successive results of one pack: the newest reply, state and parameters."""
    if before is None:
        return result
    return result._replace(
        reply=result.reply or before.reply,
        state=result.state or before.state,
        parameters=result.parameters or before.parameters,
    )
