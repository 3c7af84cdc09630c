"""Store of an edge's blocks. A block stays on disk until a worker has confirmed it, and is sent again on request.

The event loop never waits for the disk. Blocks that cannot be written wait in memory without a number. A block is sent
only after its number is on disk, since a restart could otherwise use the number again.
"""

import asyncio
import contextlib
import math
import secrets
import time
from collections import deque
from collections.abc import Callable
from typing import Self

import structlog

from bms_estimator.edge.batching import ReadyBlock
from bms_estimator.edge.block import with_oldest
from bms_estimator.edge.block_table import LATEST_S, NS_PER_S, PageRead, StoreResult, StoreTransaction
from bms_estimator.edge.subjects import BlockRequest
from bms_estimator.mqtt.connection import Message, QueuedMessage
from bms_estimator.store.database import Database, StoreError

MAX_WAITING_SAMPLES = 500_000
"""Maximum number of samples in memory while the disk cannot be written: 20 MB, or five days at one sample a second."""
RETRY_S = 1.0
"""Retry interval of a failed disk operation [s]. It may be short, because ``Database`` does not access a failed disk
before its own retry delay has passed."""
RESEND_S = 30.0
"""Minimum interval between two resends of a block [s], because a lagging worker repeats its request before the block
can arrive."""

log = structlog.get_logger(__name__)


class BlockStore:
    """Store of blocks, in order, until a worker has confirmed them; implements ``mqtt.queue_sender.MessageQueue``.

    Args:
        database: Database with ``EDGE_TABLES``, synced at each transaction; its owner opens and closes it.
        topic: Topic of the blocks.
        max_bytes: Maximum total size of blocks on disk [bytes]. Beyond it, the oldest block is dropped.
        wall: Wall clock [s since 1970].
        resend_s: Minimum interval between two resends of one block [s].

    Attributes:
        connected: True if a broker is connected, as set by the sender.
        dropped: Number of blocks lost since start, because the disk was full or damaged.
    """

    def __init__(
        self,
        database: Database,
        topic: str,
        max_bytes: int,
        *,
        wall: Callable[[], float] = time.time,
        resend_s: float = RESEND_S,
    ) -> None:
        self._database, self._topic, self._max_bytes = database, topic, max_bytes
        self._wall, self._resend_s = wall, resend_s
        self._run_id = secrets.token_hex(8)
        self._put_count = 0  # blocks put by this process
        self._waiting = deque[tuple[int, ReadyBlock]]()  # blocks that are not on disk yet, with their ``_put_count``
        self._on_disk: StoreResult | None = None  # None before the first transaction
        self._open_count_at_sync = 0  # value of database.open_count at the last transaction
        self._first_unconfirmed = 1  # workers have confirmed all blocks with lower numbers
        self._newer_than_s = 0  # the store must be created after this time [s since 1970]
        self._cursor = 1  # number of the next block to send
        self._unacknowledged = set[int]()  # numbers of sent blocks that the broker has not acknowledged
        self._last_resend = (0, -math.inf)  # block number and time
        self._loss_logged = False
        self._block_ready, self._sync_requested = asyncio.Event(), asyncio.Event()
        self._closing = False
        self._task: asyncio.Task[None] | None = None
        self.connected = False
        self.dropped = 0

    @property
    def last_s(self) -> float:
        """Time of the last sample on disk, or else the creation time of the store [s since 1970]; initially -inf."""
        return self._on_disk.state.created_s + self._on_disk.state.last_s if self._on_disk else -math.inf

    @property
    def oldest(self) -> int:
        """Number of the oldest block that can still be sent."""
        return max(self._on_disk.oldest, self._first_unconfirmed) if self._on_disk else 1

    @property
    def unconfirmed(self) -> int:
        """Number of blocks that no worker has confirmed."""
        return len(self._waiting) + (self._on_disk.state.next_number - self.oldest if self._on_disk else 0)

    @property
    def waiting(self) -> int:
        """Number of blocks that the broker has not acknowledged."""
        ready = self._on_disk.state.next_number - self._cursor if self._on_disk else 0
        return len(self._waiting) + ready + len(self._unacknowledged)

    async def __aenter__(self) -> Self:
        """Read the state of an earlier run and start the writing task."""
        await self._sync()
        self._task = asyncio.create_task(self._sync_repeatedly(), name="edge store")
        return self

    async def __aexit__(self, *_error: object) -> None:
        """Write the remaining blocks."""
        if self._task is None:
            return
        self._closing = True
        self._database.begin_shutdown()
        self._sync_requested.set()
        await self._task

    def put(self, ready: ReadyBlock) -> None:
        """Append a block, with times in seconds since 1970, without waiting for the disk."""
        if self._task is not None and self._task.done():
            self._task.result()  # only an internal error ends the task: raise it
        self._put_count += 1
        self._waiting.append((self._put_count, ready))
        while len(self._waiting) > 1 and sum(block.samples.size for _, block in self._waiting) > MAX_WAITING_SAMPLES:
            self._waiting.popleft()
            self._count_lost(1, "the disk cannot be written, and memory is full")
        self._sync_requested.set()

    def on_request(self, request: BlockRequest) -> None:
        """Handle a worker's request for its next block."""
        if self._on_disk is None or request.store < (created_ns := self._on_disk.state.created_s * NS_PER_S):
            return
        if request.store > created_ns or request.number > self._on_disk.state.next_number:
            self._request_new_store(math.ceil(request.store / NS_PER_S))  # rounded up: the new store must be later
            return
        self._first_unconfirmed = max(self._first_unconfirmed, request.number)
        self._cursor = max(self._cursor, self._first_unconfirmed)
        self._unacknowledged = {number for number in self._unacknowledged if number >= self._first_unconfirmed}
        if request.resend:
            self._resend(request.number)

    async def take(self, max_count: int) -> list[QueuedMessage]:
        """Wait for a block, then return up to ``max_count`` consecutive ones."""
        while True:
            while self._on_disk is None or self._cursor >= self._on_disk.state.next_number:
                self._block_ready.clear()
                await self._block_ready.wait()
            created_s, first = self._on_disk.state.created_s, self._cursor
            try:
                page = await self._database.call(PageRead(created_s, first, self._on_disk.state.next_number, max_count))
            except StoreError:
                await asyncio.sleep(RETRY_S)
                continue
            if (self._on_disk.state.created_s, self._cursor) != (created_s, first):
                continue  # a reply or a new store has moved the cursor while the page was read
            if page.first > first:
                self._skip_damaged(page.first)
            if page.blocks:
                self._cursor = page.blocks[-1][0] + 1
                self._unacknowledged |= {number for number, _ in page.blocks}
                return [QueuedMessage(number, self._message(number, data)) for number, data in page.blocks]

    def acknowledge(self, number: int, rejection: str = "") -> None:  # noqa: ARG002
        """Record that the broker has acknowledged a block. It stays stored, because the server may still lose it."""
        self._unacknowledged.discard(number)

    def rewind(self) -> None:
        """Make ``take`` return all unacknowledged blocks again, in order, after a lost connection."""
        self._cursor = min(self._unacknowledged, default=self._cursor)
        self._unacknowledged.clear()
        self._block_ready.set()

    def _message(self, number: int, data: bytes) -> Message:
        return Message(self._topic, with_oldest(data, min(self.oldest, number)), 1, retain=False)

    def _resend(self, number: int) -> None:
        """Send a block and all later blocks again, unless the block was resent less than ``resend_s`` ago."""
        now_s = asyncio.get_running_loop().time()
        last_number, last_s = self._last_resend
        if number >= self._cursor or (number == last_number and now_s - last_s < self._resend_s):
            return
        self._last_resend = number, now_s
        self._cursor = max(number, self.oldest)
        self._unacknowledged = {other for other in self._unacknowledged if other < self._cursor}
        self._block_ready.set()

    def _request_new_store(self, newer_than_s: int) -> None:
        """Replace the store by one created after ``newer_than_s``, because a worker has later blocks than this disk.

        The disk may have been restored from a backup.
        """
        if self._newer_than_s < newer_than_s < LATEST_S:
            log.warning("a worker has later blocks than this store: a new store is begun", newer_than_s=newer_than_s)
            self._newer_than_s = newer_than_s
            self._sync_requested.set()

    def _skip_damaged(self, first: int) -> None:
        """Skip the unreadable blocks between the cursor and ``first``.

        They count as lost only if no earlier block is unconfirmed. Otherwise a worker will request them again.
        """
        if self.oldest >= self._cursor:
            self._count_lost(first - self._cursor, "blocks on the disk are damaged")
            self._first_unconfirmed = first
        self._cursor = first

    def _count_lost(self, blocks: int, reason: str) -> None:
        if not self._loss_logged:
            log.warning("blocks of samples are lost", reason=reason, blocks=blocks)
        self._loss_logged = True
        self.dropped += blocks

    async def _sync_repeatedly(self) -> None:
        """Synchronize memory and disk on request, and retry after a failure."""
        while not self._closing:
            self._sync_requested.clear()
            written = await self._sync()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(None if written else RETRY_S):
                    await self._sync_requested.wait()
        await self._sync()

    async def _sync(self) -> bool:
        """Synchronize memory and disk. Return False if the disk failed."""
        waiting = list(self._waiting)
        reopened = self._on_disk is None or self._open_count_at_sync != self._database.open_count
        current_created_s = self._on_disk.state.created_s if self._on_disk else 0
        transaction = StoreTransaction(
            run_id=self._run_id,
            waiting=waiting,
            confirmed_below=self._first_unconfirmed,
            current_created_s=current_created_s,
            newer_than_s=self._newer_than_s,
            max_bytes=self._max_bytes,
            now_s=self._wall(),
            recompute_bytes=reopened,
        )
        try:
            result = await self._database.call(transaction)
        except StoreError:
            return False
        self._open_count_at_sync = self._database.open_count
        while self._waiting and waiting and self._waiting[0][0] <= waiting[-1][0]:
            self._waiting.popleft()
        self._apply_result(result)
        return True

    def _apply_result(self, result: StoreResult) -> None:
        """Update the numbers in memory after a transaction."""
        before, self._on_disk = self._on_disk, result
        if before is None or before.state.created_s != result.state.created_s:
            self._change_store(result, before)
        if result.dropped:
            self._count_lost(result.dropped, "the store is full")
        else:
            self._loss_logged = False
        if result.oldest > self._cursor:
            self._cursor = result.oldest
            self._unacknowledged = {number for number in self._unacknowledged if number >= self._cursor}
        self._block_ready.set()

    def _change_store(self, result: StoreResult, before: StoreResult | None) -> None:
        """Reset the numbers for a new store, and count the unconfirmed blocks of the previous store as lost."""
        if before is not None:
            self._count_lost(
                before.state.next_number - max(before.oldest, self._first_unconfirmed), "a new store is begun"
            )
        self._first_unconfirmed = self._cursor = result.oldest
        self._unacknowledged.clear()
        log.info("store of blocks", made_s=result.state.created_s, next=result.state.next_number, oldest=result.oldest)
