"""Lease of one partition by a worker: take over, process message by message, save, release.

The state follows from the order of the stream alone, so that the number of its last message defines it. Messages that may
have gone to another worker, or were lost in transit, are read from the stream again. That is also done during silence, because
messages that were delivered to a worker before it died are not delivered again.
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
from bms_estimator.fleet.nats.stored_messages import stored
from bms_estimator.fleet.nats.stream_reader import StreamError
from bms_estimator.fleet.worker.checkpoint_store import CheckpointInfo, CheckpointStore, Claim, FencedError
from bms_estimator.fleet.worker.cpu_budget import CpuBudget
from bms_estimator.fleet.worker.deferred import Span
from bms_estimator.fleet.worker.partition import BlockResult, Partition, Table
from bms_estimator.fleet.worker.pinned_consumer import DeliveredMessage, PinnedConsumer
from bms_estimator.process.tasks import until_first_ends

RETRY_S = 0.5
"""Retry interval of server requests [s]."""
SILENCE_S = 3.0
"""Time without a message after which the stream is checked for another one [s]: a worker that releases a partition
has finished by then."""
LATER_S = 5.0 * SILENCE_S
"""Time of silence after which a stream without a further message is checked again [s]."""
HOURS_AT_ONCE = 128
"""Summaries that wait for the server's answer at a time."""
TROUBLES = (NatsError, TimeoutError, StreamError)
"""Errors between worker and server that are retried."""

log = structlog.get_logger(__name__)


class PartitionLease:
    """Partition that this worker claims, and owns while no other has claimed it.

    Args:
        nc: Connected.
        number: Number of the partition.
        table: What each pack is.
        keeping: Store of the checkpoints.
        inbox: As ``PinnedConsumer`` has it.
        turn: Held while a block is stepped: of all partitions one at a time, so that the loop sees to requests and heartbeats
            between any two.
        partitions: Number of partitions of the stream.
        is_busy: Returns true while any partition of the worker has received messages that are not taken.

    Attributes:
        consumer: Requests the messages.
        partition: The state; None: not taken over.
        claim: Claim of this worker; None: it is not.
        hours: Summaries that the server has not acknowledged yet: (id, pack, row).
        lag_s: Largest lag since it was last reset to None [s].
        blocks: Taken here, as are ``samples``.
        faults: Blocks that were skipped because of an internal error.
        due_s: When a checkpoint is to be written, of a monotonic clock [s].
        trouble: What does not work now; empty: nothing.
    """

    def __init__(
        self,
        nc: Client,
        number: int,
        table: Table,
        keeping: CheckpointStore,
        inbox: str,
        turn: asyncio.Lock,
        *,
        partitions: int,
        is_busy: Callable[[], bool],
    ) -> None:
        self._partitions, self._is_busy, self._budget = partitions, is_busy, CpuBudget()
        self._nc, self.number, self._table, self._keeping = nc, number, table, keeping
        self._turn = turn
        self.consumer = PinnedConsumer(nc, number, f"{inbox}.{number}")
        self.partition: Partition | None = None
        self.claim: Claim | None = None
        self.hours: deque[tuple[str, str, bytes]] = deque()
        self.lag_s: float | None = None
        self.blocks = self.samples = self.faults = 0
        self.trouble, self.due_s = "", 0.0
        self._pin = 0  # sequence that confirmed the claim
        self._whole = False  # nothing is missing between the state and the last message given
        self._lost = self._silent = False
        self._ask_s = time.monotonic() + SILENCE_S  # when silence is to be looked into
        self._news, self._turns = asyncio.Event(), asyncio.Event()
        self._changing = asyncio.Lock()  # of state and claim
        self._sending = asyncio.Lock()

    @property
    def last_checkpoint(self) -> CheckpointInfo | None:
        """The last checkpoint."""
        return self.claim.pointer.kept[0] if self.claim and self.claim.pointer.kept else None

    @property
    def is_owned(self) -> bool:
        """True if this worker owns the partition, by its own knowledge."""
        return self.partition is not None and self.claim is not None

    def receive(self, message: Msg) -> None:
        """Take what the server sends for this partition."""
        if self.consumer.receive(message):
            self._lost, self._ask_s = True, time.monotonic() + SILENCE_S
        self._news.set()

    def check_silence(self) -> None:
        """Look into silence, if there was enough of it; to be called now and then."""
        if time.monotonic() >= self._ask_s:
            self._silent = True
            self._news.set()
        self._turns.set()

    async def run(self) -> None:
        """Take messages for ever."""
        await until_first_ends(self._run(), self._run_deferred())

    async def _run(self) -> None:
        while True:
            self._news.clear()
            if self._lost:
                await self._try(self._look)
            given = await self.consumer.take()
            if given is not None:
                await self._take(given)
                self._ask_s = time.monotonic() + SILENCE_S
            elif self._silent:
                self._silent, self._ask_s = False, time.monotonic() + SILENCE_S
                await self._try(self._read_unseen_messages)
            else:
                await self._news.wait()

    async def save(self) -> None:
        """Write a checkpoint, unless the last one is as new.

        Raises:
            nats.errors.Error: The server rejects it, or does not respond in time: the last one remains valid.
        """
        async with self._changing:
            partition, claim = self.partition, self.claim
            if partition is None or claim is None:
                return
            if (
                self.last_checkpoint
                and self.last_checkpoint.sequence == partition.sequence
                and partition.deferred.is_saved
            ):
                return
            snapshot, partition.deferred.is_saved = partition.snapshot(), True
            try:
                await self.send_hours()  # no worker makes the summaries of saved samples again
                self.claim = await self._keeping.write(claim, snapshot.sequence, snapshot.chunks())
            except FencedError as error:
                self._fenced(error)
            except BaseException:
                partition.deferred.is_saved = False
                raise

    async def send_hours(self) -> None:
        """Have the stream of summaries keep those that wait.

        Raises:
            nats.errors.Error: It does not, or not all of them: they still wait.
        """
        js = self._nc.jetstream()

        async def send(message_id: str, pack: str, row: bytes) -> None:
            await js.publish(subjects.hours(pack), row, headers={"Nats-Msg-Id": message_id})

        async with self._sending:
            while self.hours:
                rows = list(islice(self.hours, HOURS_AT_ONCE))
                await asyncio.gather(*(send(*row) for row in rows))
                for row in rows:
                    if self.hours and self.hours[0] is row:
                        self.hours.popleft()

    async def release(self) -> None:
        """Write a checkpoint and release the partition; ``run`` has ended."""
        try:
            await self.save()
        except TROUBLES as error:
            log.warning(
                "given back without a checkpoint: who has it next reads the stream from the last one",
                partition=self.number,
                reason=error_text(error),
            )
        try:
            await self.consumer.unpin()
        except TROUBLES as error:
            log.warning("not given back: that takes its time", partition=self.number, reason=error_text(error))

    def settings_changed(self, pack: str) -> None:
        """Handle new settings of a pack, or a pack that became known."""
        if self.partition:
            self.partition.settings_changed(pack)
            self._turns.set()

    async def _run_deferred(self) -> None:
        """Take deferred messages for ever, one of each pack at a time."""
        while True:
            self._turns.clear()
            while self.partition and (found := self.partition.deferred.next(self._is_due)):
                if not await self._try(partial(self._take_deferred, self.partition, *found)):
                    await asyncio.sleep(RETRY_S)
            await self._turns.wait()

    def _is_due(self, pack: str) -> bool:
        """Return whether a deferred pack may resume: within its budget, or while no other pack needs the processor."""
        is_known = self.partition is not None and self.partition.is_known(pack)
        return is_known and not (self._budget.is_exhausted(pack) and self._is_busy())

    async def _take_deferred(self, partition: Partition, pack: str, span: Span) -> None:
        """Take the next deferred message of a pack."""
        js, subject = self._nc.jetstream(), subjects.kept(self.number, pack)
        try:
            message = await js.get_msg(subjects.RAW_STREAM, span.first, subject, next=True)
        except NotFoundError:  # the stream has dropped them; the edge is asked to resend with its next block
            partition.deferred.advance(pack, span.last)
            return
        data, sequence = message.data or b"", message.seq or 0
        if sequence > span.last:
            partition.deferred.advance(pack, span.last)
            return
        take = partial(partition.take_deferred, pack, data, sequence)
        self._count(data)
        await self._publish(await self._step(pack, sequence, take))

    async def _take(self, given: DeliveredMessage) -> None:
        """Process a message after those before it; return when it is done or the partition is lost."""
        while not await self._try(lambda: self._go_on_to(given)):
            await asyncio.sleep(RETRY_S)
            if not self.consumer.pinned:
                self._whole = False
                return
        partition = self.partition
        if partition is None or given.sequence <= partition.sequence:
            return
        await self._publish(await self._take_or_defer(partition, given.pack, given.data, given.sequence))

    async def _go_on_to(self, given: DeliveredMessage) -> None:
        """Have the state of all messages before one that was given."""
        partition = self.partition
        if given.pin != self._pin or partition is None:
            self._whole = False
            async with self._changing:
                partition = await self._take_over()
            self._pin = given.pin
        if not (self._whole and given.follows):
            self._whole = False
            await self._catch_up(partition, given.sequence)
            self._whole = True

    async def _read_unseen_messages(self) -> None:
        """Have the state of all messages that the stream has, without being given any."""
        if not self.consumer.pinned and await self.consumer.is_pinned():
            await self._look()
            return
        async with self._changing:
            partition = await self._take_over()
        js, subject = self._nc.jetstream(), subjects.kept(self.number)
        try:
            await js.get_msg(subjects.RAW_STREAM, partition.sequence + 1, subject, next=True)
        except NotFoundError:
            self._ask_s = time.monotonic() + LATER_S
        else:
            await self._catch_up(partition, (await js.get_last_msg(subjects.RAW_STREAM, subject)).seq or 0)

    async def _take_over(self) -> Partition:
        """Load the state of a claimed partition, possibly an old one."""
        await self._confirm()
        partition = self.partition
        if partition is None:
            claim = await self._keeping.claim(self.number)
            partition = await self._restored(claim)
            self.partition, self.claim = partition, claim
            self._turns.set()
        last = (await self._nc.jetstream().stream_info(subjects.RAW_STREAM)).state.last_seq
        if partition.sequence > last:
            log.warning(
                "the stream ends before the checkpoint: it was made anew or has lost its end; it is read from its beginning",
                partition=self.number,
                stream=last,
                checkpoint=partition.sequence,
            )
            partition.sequence = 0
            partition.deferred.clear()
        return partition

    async def _restored(self, claim: Claim) -> Partition:
        async with aclosing(self._keeping.load(claim)) as checkpoints:
            async for kept, data in checkpoints:
                try:
                    partition = Partition.restore(self.number, self._table, data)
                except ValueError as error:
                    log.warning(
                        "a checkpoint cannot be used: going on from what was before",
                        partition=self.number,
                        object=kept.object,
                        reason=str(error),
                    )
                else:
                    log.info("taken over", partition=self.number, sequence=kept.sequence, bytes=len(data))
                    return partition
        log.info("taken over without a checkpoint: the stream is read from its beginning", partition=self.number)
        return Partition(self.number, self._table)

    async def _catch_up(self, partition: Partition, sequence: int) -> None:
        """Take what the stream has up to a message. Only the last publication of each pack is sent."""
        if partition.sequence >= sequence:
            return
        latest: dict[str, BlockResult] = {}
        subject = subjects.kept(self.number)
        messages = stored(self._nc, subjects.RAW_STREAM, subject, partition.sequence + 1, sequence)
        async with aclosing(messages):
            async for message in messages:
                pack = message.subject.rpartition(".")[2]
                taken = await self._take_or_defer(partition, pack, message.data, message.sequence)
                latest[pack] = _later(latest.get(pack), taken)
        for taken in latest.values():
            await self._publish(taken)

    async def _take_or_defer(self, partition: Partition, pack: str, data: bytes, sequence: int) -> BlockResult:
        """Take a message, or defer it if its pack has to wait."""
        if subjects.partition_of(pack, self._partitions) != self.number:
            return partition.refuse(pack, sequence)
        if pack in partition.deferred or self._budget.is_exhausted(pack):
            await asyncio.sleep(0)
            partition.defer(pack, sequence)
            self._turns.set()
            return BlockResult(pack)
        taken = await self._step(pack, sequence, partial(partition.take, pack, data, sequence))
        if pack not in partition.deferred:
            self._count(data)
        return taken

    async def _step(self, pack: str, sequence: int, take: Callable[[], BlockResult]) -> BlockResult:
        """Take a message when no other block is stepped; the time that it needs is charged to its pack."""
        async with self._turn:
            await asyncio.sleep(0)
            begin_s = time.thread_time()
            try:
                taken = take()
            except Exception:  # an internal error with one pack, which would otherwise end one worker after another
                log.exception("a block is left out", partition=self.number, pack=pack, sequence=sequence)
                taken = BlockResult(pack, failed=1)
            self._budget.charge(pack, time.thread_time() - begin_s)
        self._note(taken)
        return taken

    def _count(self, data: bytes) -> None:
        samples, arrival_s = peek_header(data)
        self.blocks += 1
        self.samples += samples
        self.lag_s = max(self.lag_s or 0.0, time.time() - arrival_s)

    def _note(self, taken: BlockResult) -> None:
        self.faults += taken.failed
        self.hours.extend((message_id, taken.pack, row) for message_id, row in taken.hours)

    async def _publish(self, taken: BlockResult) -> None:
        """Publish what a message brought for edges and pages, unless the server is away: the next brings the like."""
        if not self._nc.is_connected:
            return
        if taken.awaits is not None:
            await self._nc.publish(subjects.awaits(taken.pack), taken.awaits.model_dump_json().encode())
        for topic, payload in (("state", taken.state), ("parameters", taken.parameters)):
            if payload is not None:
                await self._nc.publish(subjects.published(taken.pack, topic), payload)

    async def _look(self) -> None:
        """Check after a lapse of the pin whether another worker owns the partition now."""
        async with self._changing:
            await self._confirm()
        self._lost = False

    async def _confirm(self) -> None:
        """Check that this worker's claim still holds; ``_changing`` is held."""
        if self.claim:
            try:
                self.claim = await self._keeping.confirm_claim(self.claim)
            except FencedError as error:
                self._fenced(error)

    def _fenced(self, error: FencedError) -> None:
        log.warning("fenced out: another worker has taken the partition over", partition=self.number, worker=str(error))
        self.partition = self.claim = None
        self._pin, self._whole = 0, False
        self.hours.clear()  # the owner of the partition computes them from the last checkpoint on

    async def _try(self, what: Callable[[], Awaitable[None]]) -> bool:
        """Return True if the server did it; log the reason if not."""
        try:
            await what()
        except FencedError as error:
            self._fenced(error)
            return False
        except TROUBLES as error:
            if (text := error_text(error)) != self.trouble:
                log.warning("waiting for the server", partition=self.number, reason=text)
            self.trouble = text
            return False
        self.trouble = ""
        return True


def _later(before: BlockResult | None, taken: BlockResult) -> BlockResult:
    """Merge two successive results of one pack into one."""
    if before is None:
        return taken
    return taken._replace(
        awaits=taken.awaits or before.awaits,
        state=taken.state or before.state,
        parameters=taken.parameters or before.parameters,
    )
