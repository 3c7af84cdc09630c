"""Edge of many packs: divides their samples into blocks, and sends the stored blocks to the stream ``RAW``."""

import asyncio
import math
import time
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import structlog
from nats.aio.client import Client
from nats.aio.msg import Msg
from nats.js.errors import NotFoundError
from pydantic import ValidationError

from bms_estimator.edge import subjects
from bms_estimator.edge.batching import Batcher
from bms_estimator.edge.block import BlockError, decode
from bms_estimator.edge.block_queue import RETRY_S, BlockQueue
from bms_estimator.edge.block_sender import MAX_BLOCK_AGE
from bms_estimator.edge.block_table import INGEST_TABLES, NS_PER_S, PackPosition, Progress
from bms_estimator.edge.subjects import BlockRequest
from bms_estimator.fleet.ingest.batch_samples import BatchSamples, Selection, select_new
from bms_estimator.fleet.nats.connection import RETRYABLE_ERRORS, error_text
from bms_estimator.fleet.worker.block_order import CONFIRM_EVERY, last_sample_s
from bms_estimator.process.runtime import end_tasks
from bms_estimator.store.database import Database

MAX_PACK_BLOCKS = 10_080
"""Maximum number of stored blocks of a pack: a week of minute blocks. Beyond it, the pack's oldest block is dropped."""
PAGE_BLOCKS = 500
"""Maximum number of blocks without an acknowledgment."""
ACK_TIMEOUT_S = 5.0
"""Timeout of the acknowledgments of a page [s]."""
HANDOVER_S = 5.0
"""Time limit for sending the remaining blocks at shutdown [s]."""
POLL_S = 0.05
"""Interval between two checks for blocks without an acknowledgment [s]."""
FILE = "ingest.sqlite"
"""Name of the database."""

log = structlog.get_logger(__name__)


@dataclass
class _OpenBlock:
    """Samples of a pack that are in no block yet."""

    batcher: Batcher
    last_s: float = -math.inf
    """Time of the last sample [s since 1970]."""
    first_sequence: int = 0
    """Sequence number of the message with the first sample."""
    opened_s: float = 0.0
    """Monotonic time of the first sample's arrival [s]."""


class IngestStore:
    """Store of the blocks of all packs, with the samples of blocks that are not complete yet, and their sender.

    Args:
        nc: Connection to the tenant's NATS account, which reconnects.
        folder: Folder of the database.
        partitions: Number of partitions of the stream ``RAW``.
        block_s: Duration of a block [s].

    Attributes:
        blocks: Store of the complete blocks.
        published: Number of acknowledged blocks since the start, with repetitions.
    """

    def __init__(self, nc: Client, folder: Path, partitions: int, block_s: float) -> None:
        self._nc, self._partitions, self._block_s, self.published = nc, partitions, block_s, 0
        self._database = Database(folder / FILE, tables=INGEST_TABLES, sync_s=0.0, retry_s=RETRY_S)
        self.blocks = BlockQueue(self._database, subjects.raw, max_blocks=MAX_PACK_BLOCKS)
        self._open: dict[str, _OpenBlock] = {}
        self._task: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        """Read the database, and start sending."""
        await self._sync(None)
        await self._nc.subscribe(subjects.block_request(), cb=self._receive)
        self._task = asyncio.create_task(self._send(), name="block sender")
        return self

    async def __aexit__(
        self, _type: type[BaseException] | None, _error: BaseException | None, _traceback: TracebackType | None
    ) -> None:
        """Close the database."""
        if self._task is not None:
            await end_tasks(self._task)
        await self._database.__aexit__()

    def last_s(self, pack: str) -> float:
        """Return the time of a pack's last sample [s since 1970]; minus infinity without one."""
        stored_s = self.blocks.position(pack).last_s
        return max(stored_s, self._open[pack].last_s) if pack in self._open else stored_s

    async def add_pack(self, pack: str) -> None:
        """Add a pack whose position is not stored. It continues after its last block in the stream ``RAW``, if any.

        Raises:
            nats.errors.Error: The server does not respond.
        """
        subject = subjects.stored_raw(subjects.partition_of(pack, self._partitions), pack)
        try:
            message = await self._nc.jetstream().get_last_msg(subjects.RAW_STREAM, subject, direct=True)
            block = decode(message.data or b"")
        except (NotFoundError, BlockError):
            self.blocks.add_pack(pack, PackPosition())
        else:
            created_s = (
                math.ceil(block.store_created_ns / NS_PER_S) + 1
            )  # a sample after this time creates a later store
            self.blocks.add_pack(pack, PackPosition(last_s=max(last_sample_s(block), created_s)))

    def add(self, pack: str, batch: BatchSamples, arrival_s: float, sequence: int) -> Selection:
        """Add the new samples of a batch, and return them with the numbers of dropped samples.

        Args:
            pack: Name of a known pack.
            batch: Samples of the batch.
            arrival_s: Time of arrival of the batch [s since 1970].
            sequence: Sequence number of the message.
        """
        selection = select_new(batch, self.last_s(pack), arrival_s)
        if selection.samples.size:
            opened = self._open.setdefault(pack, _OpenBlock(Batcher(self._block_s)))
            is_empty = not len(opened.batcher)
            completed = opened.batcher.add(selection.samples, arrival_s, selection.cells_v)
            if completed or is_empty:
                opened.first_sequence, opened.opened_s = sequence, time.monotonic()
            for ready in completed:
                self.blocks.put(pack, ready)
            opened.last_s = float(selection.samples["time_s"][-1])
        return selection

    def remove(self, pack: str) -> None:
        """Remove a pack and its blocks."""
        self._open.pop(pack, None)
        self.blocks.remove(pack)

    def complete(self, now_s: float = math.inf) -> None:
        """Complete the open blocks that are older than ``MAX_BLOCK_AGE`` times the duration of a block; by default all."""
        for pack, opened in self._open.items():
            if now_s - opened.opened_s > MAX_BLOCK_AGE * self._block_s:
                for ready in opened.batcher.cut():
                    self.blocks.put(pack, ready)

    async def save(self, stream: str, sequence: int) -> None:
        """Write all changes to disk. Repeat until the disk accepts them.

        Args:
            stream: Creation time of the stream ``TELEMETRY``.
            sequence: Sequence number of the last processed message.

        Raises:
            Exception: The sender has ended because of an internal error.
        """
        if self._task is not None and self._task.done():
            self._task.result()  # only an internal error ends the task: raise it
        first = (opened.first_sequence for opened in self._open.values() if len(opened.batcher))
        await self._sync(Progress(stream, min(first, default=sequence + 1) - 1))

    async def wait_until_sent(self) -> None:
        """Wait until the server has acknowledged all stored blocks."""
        while self.blocks.waiting:  # noqa: ASYNC110 - requests of workers end the wait, too
            await asyncio.sleep(POLL_S)

    async def send_remaining(self) -> None:
        """Wait until the server has all stored blocks, but at most ``HANDOVER_S``. The next run sends the others."""
        try:
            async with asyncio.timeout(HANDOVER_S):
                await self.wait_until_sent()
        except TimeoutError:
            log.warning("not all blocks could be sent; the next run sends the others")
        await self._sync(None)

    def request_confirmation(self, pack: str) -> None:
        """Send again the last block whose number is a multiple of ``CONFIRM_EVERY``, because workers confirm such a block."""
        self.blocks.resend_one(pack, (self.blocks.position(pack).next_number - 1) // CONFIRM_EVERY * CONFIRM_EVERY)

    async def _sync(self, progress: Progress | None) -> None:
        while not await self.blocks.sync(progress):  # noqa: ASYNC110 - a failed disk has no event
            await asyncio.sleep(RETRY_S)

    async def _receive(self, message: Msg) -> None:
        """Process a worker's request. The store ignores requests to other edges."""
        try:
            request = BlockRequest.model_validate_json(message.data)
        except ValidationError:
            log.warning("invalid message on the workers' subject", subject=message.subject)
        else:
            self.blocks.on_request(message.subject.split(".")[1], request)

    async def _send(self) -> None:
        """Publish blocks until cancelled, and repeat a page of blocks that the stream has not stored."""
        js, trouble = self._nc.jetstream(publish_async_max_pending=2 * PAGE_BLOCKS), ""
        while True:
            page, acks = await self.blocks.take(PAGE_BLOCKS), []
            try:
                for _, message in page:
                    acks.append(await js.publish_async(message.topic, message.payload))
                async with asyncio.timeout(ACK_TIMEOUT_S):
                    await asyncio.gather(*acks)
            except RETRYABLE_ERRORS as error:
                self.blocks.rewind()
                if (reason := error_text(error)) != trouble:
                    log.warning("blocks cannot be sent to the workers; they stay stored", reason=reason)
                trouble = reason
                await asyncio.sleep(RETRY_S)
            else:
                for number, _ in page:
                    self.blocks.acknowledge(number)
                self.published, trouble = self.published + len(page), ""
            finally:
                for ack in acks:
                    ack.cancel()
