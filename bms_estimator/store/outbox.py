"""Messages that must reach the broker: they wait here, oldest first, until it has acknowledged them.

While the broker accepts messages nothing is written. While it is away, or behind, queued messages are written to disk
every ``FLUSH_S``, and only a page of them stays in memory. ``kill -9`` loses at most the messages since then, a clean
end nothing.
"""

import asyncio
import contextlib
from collections import deque
from typing import Self

from bms_estimator.mqtt.message import Message, QueuedMessage
from bms_estimator.store.database import Database, StoreError
from bms_estimator.store.outbox_queue import PAGE, Queue
from bms_estimator.store.outbox_table import OutboxTransaction, Outcome, read_backlog

FLUSH_S = 1.0
"""Interval at which waiting messages are written to disk while the broker is away [s]."""
BEHIND = 3
"""Number of these intervals without an acknowledgment after which a connected broker counts as behind."""

__all__ = ["Outbox", "QueuedMessage"]


class Outbox:
    """Keeps messages in order until the broker has them.

    Args:
        database: Database for an absent broker; None: in memory only.
        most: Maximum number of stored messages; beyond it the oldest one not in flight is dropped.

    Attributes:
        connected: True if a broker is connected, as set by the sender.
    """

    def __init__(self, database: Database | None, *, most: int) -> None:
        self._database, self._queue = database, Queue(most)
        self._opened = database is None
        self._offset: int | None = None  # of numbers on disk; known once it was looked at
        self._seen: deque[int] = deque(maxlen=BEHIND)  # the next number at the last looks
        self._known = 0  # which opening of the database memory agrees with
        self._filled, self._wanted = asyncio.Event(), asyncio.Event()
        self._closing = False
        self._task: asyncio.Task[None] | None = None
        self.connected = False

    @property
    def waiting(self) -> int:
        """Messages that the broker has not acknowledged."""
        return self._queue.waiting

    @property
    def dropped(self) -> int:
        """Messages that found no room, since start."""
        return self._queue.dropped

    async def __aenter__(self) -> Self:
        """Start reading the messages on disk."""
        if self._database is not None:
            self._task = asyncio.create_task(self._stay_saved(), name="outbox")
        return self

    async def __aexit__(self, *_error: object) -> None:
        """Write the remaining messages."""
        if self._task is None or self._database is None:
            return
        self._closing = True
        self._database.begin_shutdown()
        self._wanted.set()
        await self._task

    def put(self, message: Message) -> None:
        """Keep a message; returns at once."""
        if self._task is not None and self._task.done():
            self._task.result()  # only an internal error ends the task: raise it
        self._queue.put(message)
        self._update_counts()

    async def take(self, most: int) -> list[QueuedMessage]:
        """Wait until there is a message, and hand out up to ``most`` of the oldest that were not since ``rewind``."""
        while not (self._opened and self._queue.can_hand_out):
            self._filled.clear()
            await self._filled.wait()
        taken = self._queue.take_next(most)
        if self._queue.needs_page:
            self._wanted.set()
        return taken

    def sent(self, number: int) -> None:
        """Record that the broker has acknowledged a message."""
        self._queue.sent(number)

    def rewind(self) -> None:
        """Hand out again, in order, all messages that were not acknowledged, after a connection was lost."""
        self._queue.rewind()
        self._update_counts()

    def _update_counts(self) -> None:
        if self._opened and self._queue.can_hand_out:
            self._filled.set()

    async def _stay_saved(self) -> None:
        """Each second, and when the next page is wanted."""
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        while not self._closing:
            self._wanted.clear()
            due = loop.time() >= due_s
            if due:
                due_s = loop.time() + FLUSH_S
            await self._settle(write=due and self._behind())
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout_at(due_s):
                    await self._wanted.wait()
        self._queue.rewind()
        await self._settle(write=True)

    def _behind(self) -> bool:
        """Return True if waiting messages must be written."""
        self._seen.append(self._queue.next)
        oldest = self._queue.oldest
        return oldest is not None and (not self.connected or (len(self._seen) == BEHIND and oldest < self._seen[0]))

    async def _settle(self, *, write: bool) -> None:
        """Bring disk and memory together; without the disk, memory continues alone."""
        assert self._database is not None  # noqa: S101
        queue = self._queue
        try:
            if self._offset is None:
                found = await self._database.call(read_backlog)
                self._offset = queue.found(found.runs)
                queue.dropped += found.damaged
                self._known = self._database.opened
            work = self._due(self._offset, write=write)
            if work:
                queue.writing(work.rows)
                self._done(await self._database.call(work))
            queue.disk_state_known, queue.skip_disk = self._known == self._database.opened, False
            self._known = self._database.opened
        except StoreError:
            queue.disk_state_known, queue.skip_disk = False, True
        self._opened = True
        self._update_counts()

    def _due(self, offset: int, *, write: bool) -> OutboxTransaction:
        queue, stored = self._queue, self._queue.stored
        gaps = queue.gaps() if queue.stale or not queue.disk_state_known else []
        queue.stale = False
        return OutboxTransaction(
            offset=offset,
            first=stored.first if stored else queue.next,
            end=stored.end if stored else queue.next,
            gaps=gaps,
            rows=queue.unwritten() if write or not queue.disk_state_known else [],
            page=PAGE if queue.needs_page else 0,
            recount=not queue.disk_state_known,
        )

    def _done(self, outcome: Outcome) -> None:
        """Record that a transaction is on disk."""
        queue = self._queue
        if outcome.stored is not None:
            queue.left(outcome.stored)
        queue.loaded(outcome.page, outcome.page_end)
        queue.wrote()
