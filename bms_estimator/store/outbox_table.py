"""Disk operations of the outbox, all in one transaction."""

import re
import sqlite3
from dataclasses import dataclass
from typing import Any, NamedTuple

from bms_estimator.mqtt.message import Message, QueuedMessage
from bms_estimator.store.number_ranges import NumberRanges

FARTHEST = 1 << 40
"""No number is as far from 0 in ten thousand years; one that is, is of a row that is damaged."""
MAX_TOPIC = 0xFFFF
"""[bytes]."""

_TOPIC = re.compile(r"[^+#\x00-\x1f\x7f-\x9f\ud800-\udfff]+")  # invalid UTF-8 raises the last of these
_NUMBERS = (
    "SELECT min(number), max(number) FROM (SELECT number, number - row_number() OVER (ORDER BY number) AS run "
    "FROM outbox WHERE +number > ? AND +number < ?) GROUP BY run ORDER BY 1"
)


class StoredBacklog(NamedTuple):
    """Messages on disk at the start."""

    runs: NumberRanges
    damaged: int
    """Rows that were removed."""


def read_backlog(connection: sqlite3.Connection) -> StoredBacklog:
    """Read the messages that an earlier run left."""
    beyond = "DELETE FROM outbox WHERE +number <= ? OR +number >= ?"
    damaged = connection.execute(beyond, (-FARTHEST, FARTHEST)).rowcount
    return StoredBacklog(_runs(connection, -FARTHEST, FARTHEST), damaged)


def _runs(connection: sqlite3.Connection, first: int, end: int) -> NumberRanges:
    runs: list[range] = []
    for low, high in connection.execute(_NUMBERS, (first - 1, end)):
        runs.append(range(max(low, runs[-1].stop) if runs else low, high + 1))  # in a damaged file one may occur twice
    return NumberRanges(runs)


class Outcome(NamedTuple):
    """Result of one transaction."""

    stored: NumberRanges | None
    """Number of earlier messages on disk only, if requested."""
    page: list[QueuedMessage]
    """The oldest of them, without those that are damaged."""
    page_end: int
    """One after the last number of those that were read."""


@dataclass(frozen=True)
class OutboxTransaction:
    """One transaction, which may be done twice; numbers are the queue's, ``offset`` makes those on disk of them."""

    offset: int
    first: int
    """First number that is only on disk."""
    end: int
    """One after its last."""
    gaps: list[tuple[int, int]]
    """Ranges to remove: from each number up to but excluding the second one."""
    rows: list[QueuedMessage]
    """Rows to write; existing ones are replaced."""
    page: int
    """Maximum number of the oldest messages that are read from disk."""
    recount: bool
    """True to count the messages that are only on disk, first of all."""

    def __bool__(self) -> bool:
        """Return True if there is something to do."""
        return bool(self.gaps or self.rows or self.page or self.recount)

    def __call__(self, connection: sqlite3.Connection) -> Outcome:
        """Do it."""
        alone = self.first + self.offset, self.end + self.offset
        stored = _runs(connection, *alone).moved(-self.offset) if self.recount else None
        gaps = [(begin + self.offset, end + self.offset) for begin, end in self.gaps]
        connection.executemany("DELETE FROM outbox WHERE number >= ? AND number < ?", gaps)
        rows = [(number + self.offset, *message) for number, message in self.rows]
        connection.executemany("INSERT OR REPLACE INTO outbox VALUES (?, ?, ?, ?, ?)", rows)
        if not self.page:
            return Outcome(stored, [], self.first)
        oldest = "SELECT number, topic, payload, qos, retain FROM outbox WHERE number >= ? AND number < ? ORDER BY number LIMIT ?"
        found = connection.execute(oldest, (*alone, self.page)).fetchall()
        page = [QueuedMessage(row[0] - self.offset, message) for row in found if (message := _message(*row[1:]))]
        end = found[-1][0] + 1 - self.offset if len(found) == self.page else self.end
        return Outcome(stored, page, end)


def _message(topic: Any, payload: Any, qos: Any, retain: Any) -> Message | None:
    """Return a stored message; None for a damaged row, which could not be sent."""
    sound = isinstance(topic, str) and _TOPIC.fullmatch(topic) and len(topic.encode()) <= MAX_TOPIC
    if not sound or not isinstance(payload, bytes) or qos not in (0, 1, 2) or retain not in (0, 1):
        return None
    return Message(topic, payload, int(qos), retain=bool(retain))
