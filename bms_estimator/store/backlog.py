"""What the outbox asks of the disk, all of it in one transaction."""

import sqlite3
from dataclasses import dataclass
from typing import NamedTuple

from bms_estimator.sinks.messages import Message
from bms_estimator.store.queue import Waiting


class Found(NamedTuple):
    """What is on disk at start."""

    first: int
    span: int
    messages: int


def look(connection: sqlite3.Connection) -> Found:
    """What an earlier run left."""
    first, last, count = connection.execute("SELECT min(number), max(number), count(*) FROM outbox").fetchone()
    return Found(first, last - first + 1, count) if count else Found(0, 0, 0)


class Outcome(NamedTuple):
    """Of one transaction."""

    stored: int | None
    """Messages on disk alone before it, where it was asked."""
    page: list[Waiting]
    """The oldest of them."""


@dataclass(frozen=True)
class Work:
    """One transaction; numbers are the queue's, ``offset`` makes those on disk of them."""

    offset: int
    first: int
    """Of what is on disk alone."""
    end: int
    """One after its last."""
    drops: int
    """The oldest of them, to be removed."""
    gone: list[int]
    """To be removed."""
    rows: list[Waiting]
    """To be written; what is there already is replaced."""
    page: int
    """So many of the oldest that are on disk alone are read."""
    recount: bool
    """Whether to count what is on disk alone, first of all."""

    def __bool__(self) -> bool:
        """Whether there is something to do."""
        return bool(self.drops or self.gone or self.rows or self.page or self.recount)

    def __call__(self, connection: sqlite3.Connection) -> Outcome:
        """Do it."""
        alone = self.first + self.offset, self.end + self.offset
        between = "FROM outbox WHERE number >= ? AND number < ?"
        count = connection.execute(f"SELECT count(*) {between}", alone).fetchone()[0] if self.recount else None
        if self.drops:
            oldest = f"SELECT number {between} ORDER BY number LIMIT ?"
            connection.execute(f"DELETE FROM outbox WHERE number IN ({oldest})", (*alone, self.drops))  # noqa: S608
        numbers = [(number + self.offset,) for number in self.gone]
        connection.executemany("DELETE FROM outbox WHERE number = ?", numbers)
        rows = [(number + self.offset, *message) for number, message in self.rows]
        connection.executemany("INSERT OR REPLACE INTO outbox VALUES (?, ?, ?, ?, ?)", rows)
        page: list[Waiting] = []
        if self.page:
            for number, topic, payload, qos, retain in connection.execute(
                f"SELECT number, topic, payload, qos, retain {between} ORDER BY number LIMIT ?",
                (*alone, self.page),
            ):
                page.append(Waiting(number - self.offset, Message(topic, payload, qos, retain=bool(retain))))
        return Outcome(count, page)
