"""Transactions of the outbox on its table."""

import re
import sqlite3
from dataclasses import dataclass
from typing import Any, NamedTuple

from bms_estimator.mqtt.message import Message, QueuedMessage
from bms_estimator.store.number_ranges import NumberRanges

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
