"""Blocks of an edge: on disk until a worker has confirmed them, returned in order, and again on request.

The event loop never waits for the disk. Blocks that cannot be written wait in memory without a number. Nothing is
sent without a number on disk, since a restart could otherwise use the number again.
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
from bms_estimator.edge.block_table import LATEST_S, NS, Read, StoreResult, StoreTransaction
from bms_estimator.edge.subjects import BlockRequest
from bms_estimator.mqtt.message import Message, QueuedMessage
from bms_estimator.store.database import Database, StoreError

MAX_WAITING = 500_000
"""Samples that wait in memory for a disk that takes none: 20 MB, five days at a sample a second."""
RETRY_S = 1.0
"""Retry interval of a disk operation that failed [s]; ``Database`` avoids a disk that has failed."""
RESEND_S = 30.0
"""Minimum interval between two resends of a block [s]: a worker that lags repeats its request before the block can
arrive."""

log = structlog.get_logger(__name__)


class BlockStore:
    """Keeps blocks in order until a worker has them, as ``mqtt.queue_sender.MessageQueue``.

    Args:
        database: Database with ``EDGE_TABLES``, synced at each transaction; opened and closed by its owner.
        topic: Topic of the blocks.
        most_bytes: Maximum size of blocks on disk; beyond it the oldest is dropped.
        wall: Wall clock [s since 1970].
        resend_s: Minimum interval between two resends of one block [s].

    Attributes:
        connected: True if a broker is connected, as set by the sender.
        dropped: Blocks that found no room, or could not be read, since start.
    """

    def __init__(
        self,
        database: Database,
        topic: str,
        most_bytes: int,
        *,
        wall: Callable[[], float] = time.time,
        resend_s: float = RESEND_S,
    ) -> None:
        self._database, self._topic, self._most_bytes = database, topic, most_bytes
        self._wall, self._resend_s = wall, resend_s
        self._run = secrets.token_hex(8)
        self._put, self._waiting = 0, deque[tuple[int, ReadyBlock]]()  # the latter without a number, not on disk
        self._settled: StoreResult | None = None  # None before the disk has answered
        self._known = 0  # which opening of the database that is of
        self._safe, self._after_s = 1, 0
        self._cursor, self._handed = 1, set[int]()
        self._resent = (0, -math.inf)  # number, and when
        self._full = False
        self._filled, self._wanted = asyncio.Event(), asyncio.Event()
        self._closing = False
        self._task: asyncio.Task[None] | None = None
        self.connected = False
        self.dropped = 0

    @property
    def last_s(self) -> float:
        """Time of the last sample on disk, else when the store was made [s since 1970]; minus infinity before the disk has answered."""
        return self._settled.kept.made_s + self._settled.kept.last_s if self._settled else -math.inf

    @property
    def oldest(self) -> int:
        """Number of the oldest block that can still be sent."""
        return max(self._settled.oldest, self._safe) if self._settled else 1

    @property
    def kept(self) -> int:
        """Blocks that no worker has confirmed."""
        return len(self._waiting) + (self._settled.kept.next - self.oldest if self._settled else 0)

    @property
    def waiting(self) -> int:
        """Blocks that the broker has not acknowledged."""
        ready = self._settled.kept.next - self._cursor if self._settled else 0
        return len(self._waiting) + ready + len(self._handed)

    async def __aenter__(self) -> Self:
        """Look what an earlier run has left."""
        await self._settle()
        self._task = asyncio.create_task(self._stay_settled(), name="edge store")
        return self

    async def __aexit__(self, *_error: object) -> None:
        """Write the remaining data."""
        if self._task is None:
            return
        self._closing = True
        self._database.begin_shutdown()
        self._wanted.set()
        await self._task

    def put(self, gathered: ReadyBlock) -> None:
        """Take the newest block, its times in seconds since 1970; returns at once."""
        if self._task is not None and self._task.done():
            self._task.result()  # only an internal error ends the task: raise it
        self._put += 1
        self._waiting.append((self._put, gathered))
        while len(self._waiting) > 1 and sum(block.samples.size for _, block in self._waiting) > MAX_WAITING:
            self._waiting.popleft()
            self._drop(1, "the disk takes no blocks, and memory is full")
        self._wanted.set()

    def on_request(self, awaits: BlockRequest) -> None:
        """Handle a worker's request for its next block."""
        if self._settled is None or awaits.store < (made := self._settled.kept.made_s * NS):
            return
        if awaits.store > made or awaits.number > self._settled.kept.next:
            self._begin_anew(math.ceil(awaits.store / NS))
            return
        self._safe = max(self._safe, awaits.number)
        self._cursor = max(self._cursor, self._safe)
        self._handed = {number for number in self._handed if number >= self._safe}
        if awaits.resend:
            self._send_again(awaits.number)

    async def take(self, most: int) -> list[QueuedMessage]:
        """Wait until there is a block, and hand out up to ``most`` that follow each other."""
        while True:
            while self._settled is None or self._cursor >= self._settled.kept.next:
                self._filled.clear()
                await self._filled.wait()
            made_s, first = self._settled.kept.made_s, self._cursor
            try:
                page = await self._database.call(Read(made_s, first, self._settled.kept.next, most))
            except StoreError:
                await asyncio.sleep(RETRY_S)
                continue
            if (self._settled.kept.made_s, self._cursor) != (made_s, first):
                continue
            if page.first > first:
                self._give_up(page.first)
            if page.blocks:
                self._cursor = page.blocks[-1][0] + 1
                self._handed |= {number for number, _ in page.blocks}
                return [QueuedMessage(number, self._message(number, data)) for number, data in page.blocks]

    def sent(self, number: int) -> None:
        """Record that the broker has acknowledged a block. It stays stored, because the server may still lose it."""
        self._handed.discard(number)

    def rewind(self) -> None:
        """Hand out again, in order, all blocks that were not acknowledged, after a connection was lost."""
        self._cursor = min(self._handed, default=self._cursor)
        self._handed.clear()
        self._filled.set()

    def _message(self, number: int, data: bytes) -> Message:
        return Message(self._topic, with_oldest(data, min(self.oldest, number)), 1, retain=False)

    def _send_again(self, number: int) -> None:
        """Go back to a block, and on from there."""
        now_s = asyncio.get_running_loop().time()
        before, at_s = self._resent
        if number >= self._cursor or (number == before and now_s - at_s < self._resend_s):
            return
        self._resent = number, now_s
        self._cursor = max(number, self.oldest)
        self._handed = {other for other in self._handed if other < self._cursor}
        self._filled.set()

    def _begin_anew(self, after_s: int) -> None:
        """Start a new store, because a worker is ahead of this disk, as after a restored backup; its number must be later."""
        if after_s < LATEST_S and after_s > self._after_s:
            log.warning("a worker has had later blocks than are kept here: a new store is begun", of_s=after_s)
            self._after_s = after_s
            self._wanted.set()

    def _give_up(self, first: int) -> None:
        """Give up the unreadable blocks from the cursor on.

        If an earlier block is not confirmed yet, wait until a worker requests them.
        """
        if self.oldest >= self._cursor:
            self._drop(first - self._cursor, "blocks on the disk are damaged")
            self._safe = first
        self._cursor = first

    def _drop(self, blocks: int, reason: str) -> None:
        if not self._full:
            log.warning("blocks of samples are lost", reason=reason, blocks=blocks)
        self._full = True
        self.dropped += blocks

    async def _stay_settled(self) -> None:
        """Whenever there is something to write."""
        while not self._closing:
            self._wanted.clear()
            written = await self._settle()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(None if written else RETRY_S):
                    await self._wanted.wait()
        await self._settle()

    async def _settle(self) -> bool:
        """Bring disk and memory together; False: the disk does not."""
        put = list(self._waiting)
        count = self._settled is None or self._known != self._database.opened
        known_s = self._settled.kept.made_s if self._settled else 0
        settle = StoreTransaction(
            self._run, put, self._safe, known_s, self._after_s, self._most_bytes, self._wall(), count
        )
        try:
            settled = await self._database.call(settle)
        except StoreError:
            return False
        self._known = self._database.opened
        while self._waiting and put and self._waiting[0][0] <= put[-1][0]:
            self._waiting.popleft()
        self._know(settled)
        return True

    def _know(self, settled: StoreResult) -> None:
        """Take over the numbers that are now on disk."""
        before, self._settled = self._settled, settled
        if before is None or before.kept.made_s != settled.kept.made_s:
            self._change_to(settled, before)
        if settled.dropped:
            self._drop(settled.dropped, "there is no room for more")
        else:
            self._full = False
        if settled.oldest > self._cursor:
            self._cursor = settled.oldest
            self._handed = {number for number in self._handed if number >= self._cursor}
        self._filled.set()

    def _change_to(self, settled: StoreResult, before: StoreResult | None) -> None:
        """Another store than before."""
        if before is not None:
            self._drop(before.kept.next - max(before.oldest, self._safe), "a new store is begun")
        self._safe = self._cursor = settled.oldest
        self._handed.clear()
        log.info("store of blocks", made_s=settled.kept.made_s, next=settled.kept.next, oldest=settled.oldest)
