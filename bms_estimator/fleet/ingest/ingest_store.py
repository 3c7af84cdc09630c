"""Store of the blocks that workers have not confirmed, and the samples of blocks that are not complete yet."""

import asyncio
import math
import sqlite3
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self, TypeVar

import structlog
from nats.aio.client import Client
from nats.aio.msg import Msg
from nats.js.errors import NotFoundError
from pydantic import ValidationError

from bms_estimator.edge import subjects
from bms_estimator.edge.block import BlockError, decode
from bms_estimator.edge.block_table import NS_PER_S
from bms_estimator.edge.subjects import BlockRequest
from bms_estimator.fleet.ingest.batch_samples import BatchSamples, Selection
from bms_estimator.fleet.ingest.block_publisher import BlockPublisher
from bms_estimator.fleet.ingest.open_blocks import NO_POSITION, OpenBlocks
from bms_estimator.fleet.ingest.store_table import (
    INGEST_TABLES,
    Changes,
    PackPosition,
    Progress,
    read_state,
)
from bms_estimator.fleet.worker.block_order import CONFIRM_EVERY, last_sample_s
from bms_estimator.process.runtime import end
from bms_estimator.store.database import Database, StoreError

RETRY_S = 1.0
"""Retry interval of a failed disk operation [s]."""
HANDOVER_S = 5.0
"""Time limit for sending the remaining blocks at shutdown [s]."""
FILE = "ingest.sqlite"
"""Name of the database."""

Result = TypeVar("Result")

log = structlog.get_logger(__name__)


class IngestStore:
    """Edge of many packs, which divides their samples into blocks, stores and sends the blocks, and receives confirmations.

    The blocks of a pack are numbered from 1 in its store, which is identified by its creation time.

    Args:
        nc: Connection to the tenant's NATS account, which reconnects.
        folder: Folder of the database.
        partitions: Number of partitions of the stream ``RAW``.
        block_s: Duration of a block [s].

    Attributes:
        publisher: Publisher of the blocks.
        progress: Progress in the stream ``TELEMETRY``, as stored.
        dropped: Number of blocks that were dropped, because workers did not confirm them.
    """

    publisher: BlockPublisher
    progress: Progress

    def __init__(self, nc: Client, folder: Path, partitions: int, block_s: float) -> None:
        self._nc, self._partitions, self.dropped = nc, partitions, 0
        self._database = Database(folder / FILE, tables=INGEST_TABLES, sync_s=0.0, retry_s=RETRY_S)
        self._open_blocks = OpenBlocks(block_s)
        self._first_unconfirmed: dict[str, int] = {}
        self._confirmed: dict[str, int] = {}  # changes of ``_first_unconfirmed`` since the last transaction
        self._removed: set[str] = set()
        self._file_count = 0  # ``Database.open_count`` at the last transaction
        self._task: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        """Read the database, and start sending."""
        await self._database.__aenter__()
        state = await self._call_until_done(read_state)
        self.progress, self._first_unconfirmed = state.progress, state.oldest
        self._file_count = self._database.open_count
        for pack, position in state.positions.items():
            self._open_blocks.set_position(pack, position)
        self.publisher = BlockPublisher(self._nc, self._database, state.progress.sent)
        await self._nc.subscribe(subjects.block_request(), cb=self._receive)
        self._task = asyncio.create_task(self.publisher.run(), name="block publisher")
        self.publisher.notify()
        return self

    async def __aexit__(
        self, _type: type[BaseException] | None, _error: BaseException | None, _traceback: TracebackType | None
    ) -> None:
        """Close the database."""
        if self._task is not None:
            await end(self._task)
        await self._database.__aexit__()

    def __contains__(self, pack: object) -> bool:
        return pack in self._open_blocks

    @property
    def packs(self) -> list[str]:
        """Names of the packs with a position."""
        return list(self._open_blocks)

    @property
    def unconfirmed(self) -> int:
        """Number of completed blocks that no worker has confirmed."""
        return sum(map(self.unconfirmed_of, self._open_blocks))

    def unconfirmed_of(self, pack: str) -> int:
        """Return the number of completed blocks of a pack that no worker has confirmed."""
        next_number = self._open_blocks.position(pack).next_number
        return next_number - self._first_unconfirmed.get(pack, next_number)

    async def request_confirmation(self, pack: str) -> None:
        """Send again the last block whose number is a multiple of ``CONFIRM_EVERY``, because workers confirm such a block."""
        number = (self._open_blocks.position(pack).next_number - 1) // CONFIRM_EVERY * CONFIRM_EVERY
        if number >= self._first_unconfirmed.get(pack, 1):
            await self.publisher.send_one_again(pack, number)

    def last_s(self, pack: str) -> float:
        """Return the time of a pack's last sample [s since 1970]."""
        return self._open_blocks.last_s(pack)

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
            self._open_blocks.set_position(pack, NO_POSITION)
            return
        self._begin_store_after(pack, block.store_created_ns, last_sample_s(block))

    def add(self, pack: str, batch: BatchSamples, arrival_s: float, sequence: int) -> Selection:
        """Add the new samples of a batch (``OpenBlocks.add``)."""
        self._first_unconfirmed.setdefault(pack, self._open_blocks.position(pack).next_number)
        return self._open_blocks.add(pack, batch, arrival_s, time.monotonic(), sequence)

    def remove(self, pack: str) -> None:
        """Remove a pack and its blocks."""
        self._open_blocks.remove(pack)
        self._first_unconfirmed.pop(pack, None)
        self._confirmed.pop(pack, None)
        self._removed.add(pack)

    def complete(self, now_s: float = math.inf) -> None:
        """Complete open blocks (``OpenBlocks.complete``)."""
        self._open_blocks.complete(now_s)

    async def save(self, stream: str, sequence: int) -> None:
        """Write all changes to disk. Repeat until the disk accepts them.

        Args:
            stream: Creation time of the stream ``TELEMETRY``.
            sequence: Sequence number of the last processed message.

        Raises:
            Exception: The publisher has ended because of an internal error.
        """
        if self._task is not None and self._task.done():
            self._task.result()  # only an internal error ends the task: raise it
        first_open = self._open_blocks.first_sequence(sequence + 1)
        blocks, self._open_blocks.completed = self._open_blocks.completed, []
        positions, self._open_blocks.changed = self._open_blocks.changed, {}
        confirmed, self._confirmed = self._confirmed, {}
        removed, self._removed = self._removed, set()
        progress = Progress(stream, first_open - 1, self.publisher.sent)
        if not (blocks or positions or confirmed or removed) and progress == self.progress:
            return
        dropped = await self._call_until_done(Changes(progress, blocks, positions, confirmed, removed))
        self.progress = progress
        if self._file_count != self._database.open_count:
            self._on_reopened()
        if dropped:
            log.warning("the oldest blocks are dropped, because workers do not confirm them", blocks=dropped)
            self.dropped += dropped
        if blocks:
            self.publisher.notify()

    def _on_reopened(self) -> None:
        """Write all positions and send all blocks again, because a damaged file was replaced by an empty one."""
        self._file_count = self._database.open_count
        self._open_blocks.changed = {pack: self._open_blocks.position(pack) for pack in self._open_blocks}
        self.publisher.sent = 0

    async def send_remaining(self) -> None:
        """Wait until the server has all stored blocks, but at most ``HANDOVER_S``. The next run sends the others."""
        try:
            async with asyncio.timeout(HANDOVER_S):
                await self.publisher.idle.wait()
        except TimeoutError:
            log.warning("not all blocks could be sent; the next run sends the others")

    async def _call_until_done(self, transaction: Callable[[sqlite3.Connection], Result]) -> Result:
        while True:
            try:
                return await self._database.call(transaction)
            except StoreError:
                await asyncio.sleep(RETRY_S)

    async def _receive(self, message: Msg) -> None:
        """Process a worker's request: delete confirmed blocks, and send missing ones again."""
        pack = message.subject.split(".")[1]
        if pack not in self._open_blocks:
            return  # the edge of this pack stores its blocks
        try:
            request = BlockRequest.model_validate_json(message.data)
        except ValidationError:
            log.warning("invalid message on the workers' subject", subject=message.subject)
            return
        position = self._open_blocks.position(pack)
        created_ns = position.created_s * NS_PER_S
        if request.store > created_ns or (request.store == created_ns and request.number > position.next_number):
            log.warning("a worker has later blocks of this pack than this store: a new store is begun", pack=pack)
            self._replace_store(pack, request.store)
        elif request.store == created_ns:
            self._first_unconfirmed[pack] = max(self._first_unconfirmed.get(pack, 0), request.number)
            self._confirmed[pack] = self._first_unconfirmed[pack]
            if request.resend:
                self.publisher.request_resend(pack, request.number)

    def _replace_store(self, pack: str, other_ns: int) -> None:
        """Replace the store of a pack by a new one, created later than ``other_ns`` [ns since 1970].

        Workers ignore the blocks of the former store. The samples of the open block are dropped.
        """
        last_s = self._open_blocks.position(pack).last_s
        self.remove(pack)
        self._begin_store_after(pack, other_ns, last_s)

    def _begin_store_after(self, pack: str, store_ns: int, last_s: float) -> None:
        """Begin a store with the first sample after ``last_s`` and after the creation of another store."""
        created_s = math.ceil(store_ns / NS_PER_S) + 1  # a sample after this time creates a store after the other one
        self._open_blocks.set_position(pack, PackPosition(0, 1, max(last_s, created_s)))
