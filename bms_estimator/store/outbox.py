"""Queue of messages that must reach the broker. A message stays queued until the broker acknowledges it.

While the broker acknowledges messages promptly, nothing is written to disk. While the broker is disconnected or
behind, queued messages are written every ``FLUSH_S``, and only a page of them stays in memory. ``kill -9`` loses at
most the messages since the last write; a clean shutdown loses none.
"""

import asyncio
import contextlib
import re
import sqlite3
from collections import deque
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

from bms_estimator.mqtt.connection import Message, OnResult, QueuedMessage
from bms_estimator.store.database import Database, StoreError
from bms_estimator.store.outbox_queue import PAGE, NumberRanges, OutboxQueue

MAX_ABS_NUMBER = 1 << 40
"""Bound of the absolute value of plausible message numbers, which is not reached in a thousand years. A row beyond the
bound is damaged."""
MAX_TOPIC = 0xFFFF
"""Maximum length of an MQTT topic [bytes]."""

_TOPIC = re.compile(r"[^+#\x00-\x1f\x7f-\x9f\ud800-\udfff]+")  # invalid UTF-8 is decoded to surrogates, D800..DFFF
# ``+number`` tests each row instead of seeking by number, so that misplaced rows of a damaged file are found too
_SELECT_RANGES = (
    "SELECT min(number), max(number) FROM (SELECT number, number - row_number() OVER (ORDER BY number) AS run "
    "FROM outbox WHERE +number > ? AND +number < ?) GROUP BY run ORDER BY 1"
)


class StoredBacklog(NamedTuple):
    """Messages on disk at start."""

    ranges: NumberRanges
    """Numbers of the messages on disk."""
    damaged: int
    """Number of removed rows with implausible numbers."""


def read_backlog(connection: sqlite3.Connection) -> StoredBacklog:
    """Read the messages that an earlier run left."""
    delete = "DELETE FROM outbox WHERE +number <= ? OR +number >= ?"
    damaged = connection.execute(delete, (-MAX_ABS_NUMBER, MAX_ABS_NUMBER)).rowcount
    return StoredBacklog(_stored_ranges(connection, -MAX_ABS_NUMBER, MAX_ABS_NUMBER), damaged)


def _stored_ranges(connection: sqlite3.Connection, first: int, end: int) -> NumberRanges:
    """Return the numbers of the rows from ``first`` to before ``end``."""
    ranges: list[range] = []
    for low, high in connection.execute(_SELECT_RANGES, (first - 1, end)):
        # a damaged file may repeat numbers
        ranges.append(range(max(low, ranges[-1].stop) if ranges else low, high + 1))
    return NumberRanges(ranges)


class OutboxResult(NamedTuple):
    """Result of one transaction."""

    stored: NumberRanges | None
    """Numbers of the messages that are on disk only and still have a row; None unless ``list_stored``."""
    page: list[QueuedMessage]
    """Oldest messages that are on disk only, without damaged rows."""
    page_end: int
    """Last number that was read, plus one."""


@dataclass(frozen=True)
class OutboxTransaction:
    """Idempotent transaction of the outbox. Numbers are those of the queue."""

    offset: int
    """Number on disk minus number in the queue."""
    first: int
    """First number that is on disk only."""
    end: int
    """Last number that is on disk only, plus one."""
    gaps: list[tuple[int, int]]
    """Half-open ranges of numbers to delete."""
    rows: list[QueuedMessage]
    """Messages to write. Existing rows with equal numbers are replaced."""
    page_size: int
    """Maximum number of messages to read, from the oldest."""
    list_stored: bool
    """True to list, before any change, which of the messages that are on disk only still have a row."""

    def __bool__(self) -> bool:
        """Return True if the transaction reads or writes rows."""
        return bool(self.gaps or self.rows or self.page_size or self.list_stored)

    def __call__(self, connection: sqlite3.Connection) -> OutboxResult:
        """Run the transaction."""
        disk_only = self.first + self.offset, self.end + self.offset
        stored = _stored_ranges(connection, *disk_only).shifted(-self.offset) if self.list_stored else None
        gaps = [(begin + self.offset, end + self.offset) for begin, end in self.gaps]
        connection.executemany("DELETE FROM outbox WHERE number >= ? AND number < ?", gaps)
        rows = [(number + self.offset, *message) for number, message in self.rows]
        connection.executemany("INSERT OR REPLACE INTO outbox VALUES (?, ?, ?, ?, ?)", rows)
        if not self.page_size:
            return OutboxResult(stored, [], self.first)
        oldest = "SELECT number, topic, payload, qos, retain FROM outbox WHERE number >= ? AND number < ? ORDER BY number LIMIT ?"
        read = connection.execute(oldest, (*disk_only, self.page_size)).fetchall()
        page = [QueuedMessage(row[0] - self.offset, message) for row in read if (message := _message(*row[1:]))]
        end = read[-1][0] + 1 - self.offset if len(read) == self.page_size else self.end
        return OutboxResult(stored, page, end)


def _message(topic: Any, payload: Any, qos: Any, retain: Any) -> Message | None:
    """Return a stored message; None for a damaged row."""
    valid_topic = isinstance(topic, str) and _TOPIC.fullmatch(topic) and len(topic.encode()) <= MAX_TOPIC
    if not valid_topic or not isinstance(payload, bytes) or qos not in (0, 1, 2) or retain not in (0, 1):
        return None
    return Message(topic, payload, int(qos), retain=bool(retain))


FLUSH_S = 1.0
"""Interval at which queued messages are written to disk while the broker is disconnected or behind [s]."""
BEHIND_INTERVALS = 3
"""Number of intervals ``FLUSH_S``. A connected broker that has not acknowledged a message for this long counts as
behind."""

__all__ = ["Outbox", "QueuedMessage"]


class Outbox:
    """Store of messages, in order, until the broker acknowledges them.

    Args:
        database: Database for messages during an outage; None: memory only.
        max_messages: Maximum number of queued messages; beyond it the oldest one not in flight is dropped. Messages with
            an ``on_result`` are dropped last.

    Attributes:
        connected: True if a broker is connected, as set by the sender.
    """

    def __init__(self, database: Database | None, *, max_messages: int) -> None:
        self._database, self._queue = database, OutboxQueue(max_messages)
        self._backlog_read = database is None
        self._offset: int | None = None  # number on disk minus number in the queue; None until the backlog was read
        self._next_numbers: deque[int] = deque(maxlen=BEHIND_INTERVALS)  # the queue's next number, at each interval
        self._open_count_at_sync = 0  # database.open_count at the last synchronization of memory and disk
        self._message_ready, self._sync_requested = asyncio.Event(), asyncio.Event()
        self._closing = False
        self._task: asyncio.Task[None] | None = None
        self.connected = False

    @property
    def waiting(self) -> int:
        """Number of messages that the broker has not acknowledged."""
        return self._queue.waiting

    @property
    def dropped(self) -> int:
        """Number of messages lost since start, because the queue was full or the disk was damaged."""
        return self._queue.dropped

    async def __aenter__(self) -> Self:
        """Start reading the messages on disk."""
        if self._database is not None:
            self._task = asyncio.create_task(self._sync_repeatedly(), name="outbox")
        return self

    async def __aexit__(self, *_error: object) -> None:
        """Write the remaining messages."""
        if self._task is None or self._database is None:
            return
        self._closing = True
        self._database.begin_shutdown()
        self._sync_requested.set()
        await self._task

    def put(self, message: Message, on_result: OnResult | None = None) -> None:
        """Queue a message without waiting for the disk. ``on_result`` receives its result, unless this process ends before."""
        if self._task is not None and self._task.done():
            self._task.result()  # only an internal error ends the task: raise it
        self._queue.put(message, on_result)
        self._wake_taker()

    async def take(self, max_count: int) -> list[QueuedMessage]:
        """Wait for a message, then return up to ``max_count`` of the oldest messages not yet returned since ``rewind``."""
        while not (self._backlog_read and self._queue.can_take):
            self._message_ready.clear()
            await self._message_ready.wait()
        taken = self._queue.take_next(max_count)
        if self._queue.needs_page:
            self._sync_requested.set()
        return taken

    def acknowledge(self, number: int, rejection: str = "") -> None:
        """Record that the broker has acknowledged a message, or the reason why it has permanently rejected the message."""
        self._queue.acknowledge(number, rejection)

    def rewind(self) -> None:
        """Make ``take`` return all unacknowledged messages again, in order, after a lost connection."""
        self._queue.rewind()
        self._wake_taker()

    def _wake_taker(self) -> None:
        if self._backlog_read and self._queue.can_take:
            self._message_ready.set()

    async def _sync_repeatedly(self) -> None:
        """Synchronize memory and disk every ``FLUSH_S``, and when the next page is needed."""
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        while not self._closing:
            self._sync_requested.clear()
            due = loop.time() >= due_s
            if due:
                due_s = loop.time() + FLUSH_S
            await self._sync(write=due and self._must_write())
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout_at(due_s):
                    await self._sync_requested.wait()
        await self._sync(write=True)

    def _must_write(self) -> bool:
        """Return True if queued messages must be written, because the broker is disconnected or behind."""
        self._next_numbers.append(self._queue.next_number)
        oldest = self._queue.oldest
        if oldest is None:
            return False
        return not self.connected or (len(self._next_numbers) == BEHIND_INTERVALS and oldest < self._next_numbers[0])

    async def _sync(self, *, write: bool) -> None:
        """Synchronize memory and disk; if the disk fails, continue in memory."""
        assert self._database is not None  # noqa: S101
        queue = self._queue
        try:
            if self._offset is None:
                backlog = await self._database.call(read_backlog)
                self._offset = queue.prepend_backlog(backlog.ranges)
                queue.dropped += backlog.damaged
                self._open_count_at_sync = self._database.open_count
            transaction = self._transaction(self._offset, write=write)
            if transaction:
                queue.mark_writing(transaction.rows)
                self._apply_result(await self._database.call(transaction))
            # a database that was reopened since the last synchronization may have lost rows
            queue.disk_state_known = self._open_count_at_sync == self._database.open_count
            queue.skip_disk = False
            self._open_count_at_sync = self._database.open_count
        except StoreError:
            queue.disk_state_known = False
            queue.skip_disk = True
        self._backlog_read = True
        self._wake_taker()

    def _transaction(self, offset: int, *, write: bool) -> OutboxTransaction:
        """Return the transaction that makes the disk match memory, and record that no stale rows will remain.

        The transaction deletes rows that are no longer queued, writes new messages and reads the next page. If the state
        of the disk is unknown, it also writes all messages in memory again and lists the rows on disk.
        """
        queue, stored = self._queue, self._queue.stored
        gaps = queue.gaps() if queue.has_stale_rows or not queue.disk_state_known else []
        queue.has_stale_rows = False
        return OutboxTransaction(
            offset=offset,
            first=stored.first if stored else queue.next_number,
            end=stored.end if stored else queue.next_number,
            gaps=gaps,
            rows=queue.unwritten() if write or not queue.disk_state_known else [],
            page_size=PAGE if queue.needs_page else 0,
            list_stored=not queue.disk_state_known,
        )

    def _apply_result(self, result: OutboxResult) -> None:
        """Update the queue after a transaction."""
        queue = self._queue
        if result.stored is not None:
            queue.retain_stored(result.stored)
        queue.add_page(result.page, result.page_end)
        queue.mark_written()
