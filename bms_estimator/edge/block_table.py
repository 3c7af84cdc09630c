"""Tables of an edge's blocks, and the transactions on them."""

import sqlite3
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from bms_estimator.edge.batching import ReadyBlock
from bms_estimator.edge.block import MAX_NUMBER, Block, BlockError, decode, encode

NS = 1_000_000_000
"""Nanoseconds in a second."""
LATEST_S = MAX_NUMBER // NS - 1
"""Latest creation time of a store, in the year 2262 [s since 1970]."""
DROP_ROWS = 64
"""Maximum number of rows that are read at a time when blocks are dropped."""
EDGE_TABLES = (
    """
    CREATE TABLE store (
        made_s INTEGER NOT NULL,
        next INTEGER NOT NULL,
        last_s REAL NOT NULL,
        bytes INTEGER NOT NULL,
        run TEXT NOT NULL,
        taken INTEGER NOT NULL
    );
    CREATE TABLE block (number INTEGER PRIMARY KEY, data BLOB NOT NULL);
    """,
)
"""Statements that create the tables, as ``store.migrations.MIGRATIONS``."""


class StoreState(NamedTuple):
    """Row of table ``store``."""

    made_s: int
    """Creation time [s since 1970]: whole seconds, so that sample times relative to it are exact."""
    next: int
    """Number of the next block."""
    last_s: float
    """Time of the last sample since the creation of the store [s]; 0 without samples."""
    bytes: int
    """Total size of the blocks [bytes]."""
    run: str
    """Identifier of the process that inserted the last block."""
    taken: int
    """Number of blocks that this process has inserted."""


class StoreResult(NamedTuple):
    """State of the store after a transaction."""

    state: StoreState
    """Row of table ``store``."""
    oldest: int
    """Number of the oldest block on disk; ``state.next`` without blocks."""
    dropped: int
    """Number of blocks dropped because the store was full."""


@dataclass(frozen=True)
class StoreTransaction:
    """Idempotent transaction that inserts blocks, deletes confirmed ones and drops the oldest beyond the size limit.

    Raises:
        sqlite3.Error: The database cannot be read or written.
    """

    run: str
    """Identifier of this process, by which blocks that were already inserted are skipped."""
    put: Sequence[tuple[int, ReadyBlock]]
    """Blocks and their running numbers in this process, from 1; their times are seconds since 1970."""
    safe: int
    """Number below which blocks are deleted, because workers have confirmed them."""
    known_s: int
    """Creation time of the store in memory [s since 1970]; 0 without one. An earlier store on disk is replaced."""
    after_s: int
    """Time after which the store must have been created [s since 1970]; otherwise it is replaced."""
    most_bytes: int
    """Maximum total size of the blocks on disk [bytes]."""
    now_s: float
    """Wall clock [s since 1970]."""
    count: bool
    """True to compute the total size of the blocks from the rows."""

    def __call__(self, connection: sqlite3.Connection) -> StoreResult:
        """Run the transaction."""
        state = _stored_state(connection)
        if state is None or state.made_s < self.known_s or state.made_s <= self.after_s:
            state = self._begin(connection)
        else:
            removed = _bytes(connection, f"WHERE number < {self.safe:d}")
            connection.execute("DELETE FROM block WHERE number < ?", (self.safe,))
            state = state._replace(bytes=_bytes(connection) if self.count else state.bytes - removed)
        inserted = state.taken if state.run == self.run else 0
        for index, ready in self.put:
            if index > inserted:
                state = _insert(connection, state, ready)._replace(run=self.run, taken=index)
        state, dropped = _make_room(connection, state, self.most_bytes)
        connection.execute("DELETE FROM store")
        connection.execute("INSERT INTO store VALUES (?, ?, ?, ?, ?, ?)", state)
        (oldest,) = connection.execute("SELECT min(number) FROM block").fetchone()
        return StoreResult(state, state.next if oldest is None else oldest, dropped)

    def _begin(self, connection: sqlite3.Connection) -> StoreState:
        """Create a store, stamped with the time of its first waiting sample."""
        connection.execute("DELETE FROM block")
        first_s = float(self.put[0][1].samples["time_s"][0]) if self.put else self.now_s
        return StoreState(max(int(first_s), self.known_s + 1, self.after_s + 1), 1, 0.0, 0, "", 0)


class Page(NamedTuple):
    """Consecutive blocks read from disk."""

    first: int
    """Number of the first readable block."""
    blocks: list[tuple[int, bytes]]
    """Numbers and encoded blocks."""


@dataclass(frozen=True)
class PageRead:
    """Transaction that reads consecutive blocks.

    Raises:
        sqlite3.Error: The database cannot be read.
    """

    made_s: int
    """Creation time of the store [s since 1970]."""
    first: int
    """Number of the first block."""
    end: int
    """Number after the last block."""
    most: int
    """Maximum number of blocks."""

    def __call__(self, connection: sqlite3.Connection) -> Page:
        """Run the transaction."""
        query = "SELECT number, data FROM block WHERE number >= ? AND number < ? ORDER BY number LIMIT ?"
        blocks = list[tuple[int, bytes]]()
        first = self.end
        for number, data in connection.execute(query, (self.first, self.end, self.most)).fetchall():
            if not _is_valid(self.made_s, number, data):
                if blocks:
                    break
                first = number + 1
            elif blocks and number != blocks[-1][0] + 1:
                break
            else:
                blocks.append((number, data))
        return Page(blocks[0][0] if blocks else first, blocks)


def _stored_state(connection: sqlite3.Connection) -> StoreState | None:
    """Read the existing store; None if it is not valid."""
    row = connection.execute("SELECT made_s, next, last_s, bytes, run, taken FROM store").fetchone()
    if row is None or [*map(type, row)] != [int, int, float, int, str, int]:
        return None
    state = StoreState(*row)
    return state if 0 < state.made_s <= LATEST_S and 0 < state.next < MAX_NUMBER else None


def _insert(connection: sqlite3.Connection, state: StoreState, ready: ReadyBlock) -> StoreState:
    samples = ready.samples.copy()
    samples["time_s"] = np.maximum(samples["time_s"] - state.made_s, state.last_s)
    data = encode(Block(state.made_s * NS, state.next, state.next, ready.arrival_s, samples))
    connection.execute("INSERT OR REPLACE INTO block VALUES (?, ?)", (state.next, data))
    last_s = float(samples["time_s"][-1])
    return state._replace(next=state.next + 1, last_s=last_s, bytes=state.bytes + len(data))


def _make_room(connection: sqlite3.Connection, state: StoreState, most_bytes: int) -> tuple[StoreState, int]:
    """Drop the oldest blocks beyond the size limit, but never the newest one."""
    dropped = 0
    oldest = "SELECT number, length(data) FROM block WHERE number < ? ORDER BY number LIMIT ?"
    while state.bytes > most_bytes and (rows := connection.execute(oldest, (state.next - 1, DROP_ROWS)).fetchall()):
        for number, size in rows:
            if state.bytes <= most_bytes:
                break
            connection.execute("DELETE FROM block WHERE number = ?", (number,))
            state = state._replace(bytes=state.bytes - size)
            dropped += 1
    return state, dropped


def _bytes(connection: sqlite3.Connection, condition: str = "") -> int:
    (size,) = connection.execute(f"SELECT coalesce(sum(length(data)), 0) FROM block {condition}").fetchone()  # noqa: S608 - constant text and an integer
    return int(size)


def _is_valid(made_s: int, number: int, data: Any) -> bool:
    """Return True if a row holds the undamaged block of its number."""
    if not isinstance(data, bytes):
        return False
    try:
        block = decode(data)
    except BlockError:
        return False
    return block.store == made_s * NS and block.number == number
