"""Tables of an edge's blocks, and the transactions on them."""

import sqlite3
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from bms_estimator.edge.batching import ReadyBlock
from bms_estimator.edge.block import MAX_NUMBER, Block, BlockError, decode, encode

NS_PER_S = 1_000_000_000
LATEST_S = MAX_NUMBER // NS_PER_S - 1
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
"""Statements that create the tables, one item for each version, in the format of ``store.migrations.MIGRATIONS``."""


class StoreState(NamedTuple):
    """Only row of table ``store``, in the order of its columns."""

    created_s: int
    """Creation time [s since 1970]: whole seconds, so that sample times relative to it are exact."""
    next_number: int
    """Number of the next block."""
    last_s: float
    """Time of the last sample since the creation of the store [s]; 0 without samples."""
    bytes: int
    """Total size of the blocks [bytes]."""
    run_id: str
    """Identifier of the process that inserted the last block."""
    inserted_by_run: int
    """Number of blocks that this process has inserted."""


class StoreResult(NamedTuple):
    """State of the store after a transaction."""

    state: StoreState
    """Row of table ``store``."""
    oldest: int
    """Number of the oldest block on disk; ``state.next_number`` without blocks."""
    dropped: int
    """Number of blocks dropped because the store was full."""


@dataclass(frozen=True)
class StoreTransaction:
    """Idempotent transaction that inserts blocks, deletes confirmed ones and drops the oldest beyond the size limit.

    Raises:
        sqlite3.Error: The database cannot be read or written.
    """

    run_id: str
    """Identifier of this process, by which a repeated transaction skips blocks that were already inserted."""
    waiting: Sequence[tuple[int, ReadyBlock]]
    """Blocks to insert, with their running numbers in this process, from 1; sample times are seconds since 1970."""
    confirmed_below: int
    """Number below which blocks are deleted, because workers have confirmed them."""
    current_created_s: int
    """Creation time of the store that this process uses [s since 1970]; 0 if it has none yet. An older store on disk is
    an outdated copy and is replaced."""
    newer_than_s: int
    """The store is replaced unless it was created after this time [s since 1970], because workers ignore blocks of a
    store that is older than the newest that they know."""
    max_bytes: int
    """Maximum total size of the blocks on disk [bytes]."""
    now_s: float
    """Wall clock [s since 1970]."""
    recompute_bytes: bool
    """True to compute the total size of the blocks from the rows."""

    def __call__(self, connection: sqlite3.Connection) -> StoreResult:
        """Run the transaction."""
        state = _stored_state(connection)
        if state is None or state.created_s < self.current_created_s or state.created_s <= self.newer_than_s:
            state = self._create_store(connection)
        else:
            removed = _total_bytes(connection, f"WHERE number < {self.confirmed_below:d}")
            connection.execute("DELETE FROM block WHERE number < ?", (self.confirmed_below,))
            state = state._replace(bytes=_total_bytes(connection) if self.recompute_bytes else state.bytes - removed)
        inserted = state.inserted_by_run if state.run_id == self.run_id else 0
        for running_number, ready in self.waiting:
            if running_number > inserted:
                state = _insert(connection, state, ready)._replace(run_id=self.run_id, inserted_by_run=running_number)
        state, dropped = _drop_excess(connection, state, self.max_bytes)
        connection.execute("DELETE FROM store")
        connection.execute("INSERT INTO store VALUES (?, ?, ?, ?, ?, ?)", state)
        (oldest,) = connection.execute("SELECT min(number) FROM block").fetchone()
        return StoreResult(state, state.next_number if oldest is None else oldest, dropped)

    def _create_store(self, connection: sqlite3.Connection) -> StoreState:
        """Create a store, stamped with the time of its first waiting sample."""
        connection.execute("DELETE FROM block")
        first_s = float(self.waiting[0][1].samples["time_s"][0]) if self.waiting else self.now_s
        return StoreState(
            created_s=max(int(first_s), self.current_created_s + 1, self.newer_than_s + 1),
            next_number=1,
            last_s=0.0,
            bytes=0,
            run_id="",
            inserted_by_run=0,
        )


class Page(NamedTuple):
    """Consecutive blocks read from disk."""

    first: int
    """Number of the first block of the page. Without blocks, all blocks before this number are damaged or missing."""
    blocks: list[tuple[int, bytes]]
    """Numbers and encoded blocks."""


@dataclass(frozen=True)
class PageRead:
    """Transaction that reads consecutive undamaged blocks. Damaged blocks before the first of them are skipped.

    Raises:
        sqlite3.Error: The database cannot be read.
    """

    created_s: int
    """Creation time of the store [s since 1970]."""
    first: int
    """Number of the first block."""
    end: int
    """Number after the last block."""
    max_blocks: int
    """Maximum number of blocks."""

    def __call__(self, connection: sqlite3.Connection) -> Page:
        """Run the transaction."""
        query = "SELECT number, data FROM block WHERE number >= ? AND number < ? ORDER BY number LIMIT ?"
        blocks = list[tuple[int, bytes]]()
        first_undamaged = self.end
        for number, data in connection.execute(query, (self.first, self.end, self.max_blocks)).fetchall():
            if not _is_valid(self.created_s, number, data):
                if blocks:
                    break
                first_undamaged = number + 1
            elif blocks and number != blocks[-1][0] + 1:
                break
            else:
                blocks.append((number, data))
        return Page(blocks[0][0] if blocks else first_undamaged, blocks)


def _stored_state(connection: sqlite3.Connection) -> StoreState | None:
    """Read the existing store; None if it is not valid."""
    row = connection.execute("SELECT made_s, next, last_s, bytes, run, taken FROM store").fetchone()
    if row is None or [*map(type, row)] != [int, int, float, int, str, int]:
        return None
    state = StoreState(*row)
    return state if 0 < state.created_s <= LATEST_S and 0 < state.next_number < MAX_NUMBER else None


def _insert(connection: sqlite3.Connection, state: StoreState, ready: ReadyBlock) -> StoreState:
    samples = ready.samples.copy()
    # sample times never decrease within a store, even if the clock was set back before a restart
    samples["time_s"] = np.maximum(samples["time_s"] - state.created_s, state.last_s)
    block = Block(
        store_created_ns=state.created_s * NS_PER_S,
        number=state.next_number,
        oldest=state.next_number,  # replaced by the oldest number at the time of sending
        arrival_s=ready.arrival_s,
        samples=samples,
        cells_v=ready.cells_v,
    )
    data = encode(block)
    connection.execute("INSERT OR REPLACE INTO block VALUES (?, ?)", (state.next_number, data))
    last_s = float(samples["time_s"][-1])
    return state._replace(next_number=state.next_number + 1, last_s=last_s, bytes=state.bytes + len(data))


def _drop_excess(connection: sqlite3.Connection, state: StoreState, max_bytes: int) -> tuple[StoreState, int]:
    """Drop the oldest blocks beyond the size limit, but never the newest one."""
    dropped = 0
    oldest = "SELECT number, length(data) FROM block WHERE number < ? ORDER BY number LIMIT ?"
    while state.bytes > max_bytes and (
        rows := connection.execute(oldest, (state.next_number - 1, DROP_ROWS)).fetchall()
    ):
        for number, size in rows:
            if state.bytes <= max_bytes:
                break
            connection.execute("DELETE FROM block WHERE number = ?", (number,))
            state = state._replace(bytes=state.bytes - size)
            dropped += 1
    return state, dropped


def _total_bytes(connection: sqlite3.Connection, condition: str = "") -> int:
    (size,) = connection.execute(f"SELECT coalesce(sum(length(data)), 0) FROM block {condition}").fetchone()  # noqa: S608 - constant text and an integer
    return int(size)


def _is_valid(created_s: int, number: int, data: Any) -> bool:
    """Return True if a row holds the undamaged block of its number."""
    if not isinstance(data, bytes):
        return False
    try:
        block = decode(data)
    except BlockError:
        return False
    return block.store_created_ns == created_s * NS_PER_S and block.number == number
