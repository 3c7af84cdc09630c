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
_NUMBERS = (
    "SELECT min(number), max(number) FROM (SELECT number, number - row_number() OVER (ORDER BY number) AS run "
    "FROM outbox WHERE +number > ? AND +number < ?) GROUP BY run ORDER BY 1"
)


class StoredBacklog(NamedTuple):
    """Messages on disk at start."""

    runs: NumberRanges
    damaged: int
    """Number of removed rows with implausible numbers."""


def read_backlog(connection: sqlite3.Connection) -> StoredBacklog:
    """Read the messages that an earlier run left."""
    delete = "DELETE FROM outbox WHERE +number <= ? OR +number >= ?"
    damaged = connection.execute(delete, (-MAX_ABS_NUMBER, MAX_ABS_NUMBER)).rowcount
    return StoredBacklog(_runs(connection, -MAX_ABS_NUMBER, MAX_ABS_NUMBER), damaged)


def _runs(connection: sqlite3.Connection, first: int, end: int) -> NumberRanges:
    runs: list[range] = []
    for low, high in connection.execute(_NUMBERS, (first - 1, end)):
        runs.append(range(max(low, runs[-1].stop) if runs else low, high + 1))  # a damaged file may repeat numbers
    return NumberRanges(runs)


class OutboxResult(NamedTuple):
    """Result of one transaction."""

    stored: NumberRanges | None
    """Numbers of the existing rows among the messages that are on disk only; None unless requested."""
    page: list[QueuedMessage]
    """Oldest messages on disk only, without damaged rows."""
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
    page: int
    """Maximum number of messages to read, from the oldest."""
    recount: bool
    """True to list, before any change, those messages on disk only whose rows exist."""

    def __bool__(self) -> bool:
        """Return True if the transaction reads or writes rows."""
        return bool(self.gaps or self.rows or self.page or self.recount)

    def __call__(self, connection: sqlite3.Connection) -> OutboxResult:
        """Run the transaction."""
        disk_only = self.first + self.offset, self.end + self.offset
        stored = _runs(connection, *disk_only).shifted(-self.offset) if self.recount else None
        gaps = [(begin + self.offset, end + self.offset) for begin, end in self.gaps]
        connection.executemany("DELETE FROM outbox WHERE number >= ? AND number < ?", gaps)
        rows = [(number + self.offset, *message) for number, message in self.rows]
        connection.executemany("INSERT OR REPLACE INTO outbox VALUES (?, ?, ?, ?, ?)", rows)
        if not self.page:
            return OutboxResult(stored, [], self.first)
        oldest = "SELECT number, topic, payload, qos, retain FROM outbox WHERE number >= ? AND number < ? ORDER BY number LIMIT ?"
        read = connection.execute(oldest, (*disk_only, self.page)).fetchall()
        page = [QueuedMessage(row[0] - self.offset, message) for row in read if (message := _message(*row[1:]))]
        end = read[-1][0] + 1 - self.offset if len(read) == self.page else self.end
        return OutboxResult(stored, page, end)


def _message(topic: Any, payload: Any, qos: Any, retain: Any) -> Message | None:
    """Return a stored message; None for a damaged row."""
    valid_topic = isinstance(topic, str) and _TOPIC.fullmatch(topic) and len(topic.encode()) <= MAX_TOPIC
    if not valid_topic or not isinstance(payload, bytes) or qos not in (0, 1, 2) or retain not in (0, 1):
        return None
    return Message(topic, payload, int(qos), retain=bool(retain))
