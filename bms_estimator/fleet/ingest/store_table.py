"""Tables of the blocks of all packs that are not confirmed yet, and the transactions on them."""

import sqlite3
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Self

from bms_estimator.edge.batching import ReadyBlock
from bms_estimator.edge.block import Block, encode, with_oldest
from bms_estimator.edge.block_table import NS_PER_S

MAX_PACK_BLOCKS = 10_080
"""Maximum number of stored blocks of a pack: a week of minute blocks. Beyond it, the pack's oldest block is dropped."""
INGEST_TABLES = (
    """
    CREATE TABLE pack (
        name TEXT PRIMARY KEY, made_s INTEGER NOT NULL, next INTEGER NOT NULL, last_s REAL NOT NULL
    ) WITHOUT ROWID;
    CREATE TABLE block (
        id INTEGER PRIMARY KEY AUTOINCREMENT, pack TEXT NOT NULL, number INTEGER NOT NULL, data BLOB NOT NULL
    );
    CREATE UNIQUE INDEX block_number ON block (pack, number);
    CREATE TABLE progress (stream TEXT NOT NULL, sequence INTEGER NOT NULL, sent INTEGER NOT NULL);
    """,
)
"""Statements that create the tables, one item for each version, in the format of ``store.migrations.MIGRATIONS``."""


class PackPosition(NamedTuple):
    """Position of a pack in the blocks of its store."""

    created_s: int
    """Creation time of the pack's store [s since 1970]; 0 before its first block."""
    next_number: int
    """Number of the next block."""
    last_s: float
    """Time of the last sample in a block [s since 1970]. Samples up to this time are dropped."""

    def after(self, ready: ReadyBlock) -> "PackPosition":
        """Return the position after a block. The first block creates the store, at the time of its first sample."""
        created_s = self.created_s or int(ready.samples["time_s"][0])
        return PackPosition(created_s, self.next_number + 1, float(ready.samples["time_s"][-1]))


class NumberedBlock(NamedTuple):
    """Encoded block of a pack with its number."""

    pack: str
    number: int
    data: bytes

    @classmethod
    def of(cls, pack: str, number: int, created_s: int, ready: ReadyBlock) -> Self:
        """Return the encoded block, with times since the creation of the store [s since 1970].

        Raises:
            Exception: The block cannot be encoded.
        """
        samples = ready.samples.copy()
        samples["time_s"] -= created_s  # exact, because the creation time is a whole number of seconds
        oldest = number  # replaced at the time of sending
        block = Block(created_s * NS_PER_S, number, oldest, ready.arrival_s, samples, ready.cells_v)
        return cls(pack, number, encode(block))


class Progress(NamedTuple):
    """Only row of table ``progress``."""

    stream: str
    """Creation time of the stream ``TELEMETRY``, which identifies it."""
    sequence: int
    """Stream sequence number up to which all accepted samples are in stored blocks."""
    sent: int
    """Largest id of a block that the server has acknowledged."""


@dataclass(frozen=True)
class Changes:
    """Idempotent transaction that writes all changes since the last one, and returns the number of dropped blocks.

    Raises:
        sqlite3.Error: The database cannot be written.
    """

    progress: Progress
    blocks: Sequence[NumberedBlock] = ()
    positions: Mapping[str, PackPosition] = field(default_factory=dict)
    confirmed_below: Mapping[str, int] = field(default_factory=dict)
    """Number of the first unconfirmed block, by pack."""
    removed: Collection[str] = ()
    """Packs whose blocks and position are removed, before blocks are inserted."""

    def __call__(self, connection: sqlite3.Connection) -> int:
        """Run the transaction."""
        for pack in self.removed:
            connection.execute("DELETE FROM block WHERE pack = ?", (pack,))
            connection.execute("DELETE FROM pack WHERE name = ?", (pack,))
        connection.executemany("INSERT OR REPLACE INTO block (pack, number, data) VALUES (?, ?, ?)", self.blocks)
        rows_of_packs = ((pack, *position) for pack, position in self.positions.items())
        connection.executemany("INSERT OR REPLACE INTO pack VALUES (?, ?, ?, ?)", rows_of_packs)
        delete = "DELETE FROM block WHERE pack = ? AND number < ?"
        connection.executemany(delete, self.confirmed_below.items())
        limits = [(pack, position.next_number - MAX_PACK_BLOCKS) for pack, position in self.positions.items()]
        dropped = connection.executemany(delete, limits).rowcount if limits else 0
        connection.execute("DELETE FROM progress")
        connection.execute("INSERT INTO progress VALUES (?, ?, ?)", self.progress)
        return dropped


class StoredState(NamedTuple):
    """Content of the database at the start, without the blocks."""

    progress: Progress
    positions: dict[str, PackPosition]
    oldest: dict[str, int]
    """Number of the oldest stored block by pack."""


def read_state(connection: sqlite3.Connection) -> StoredState:
    """Read the state.

    Raises:
        sqlite3.Error: The database cannot be read.
    """
    row = connection.execute("SELECT stream, sequence, sent FROM progress").fetchone()
    packs = connection.execute("SELECT name, made_s, next, last_s FROM pack")
    oldest = connection.execute("SELECT pack, min(number) FROM block GROUP BY pack")
    return StoredState(
        Progress(*row) if row else Progress("", 0, 0),
        {name: PackPosition(*position) for name, *position in packs},
        dict(oldest.fetchall()),
    )


class StoredBlock(NamedTuple):
    """Stored block, ready to be sent."""

    id: int
    pack: str
    number: int
    data: bytes


@dataclass(frozen=True)
class BlockPage:
    """Transaction that reads blocks in the order of their insertion, or of their numbers for a single pack.

    Raises:
        sqlite3.Error: The database cannot be read.
    """

    max_blocks: int
    after_id: int = 0
    """Id of the last block before the page."""
    pack: str = ""
    """Pack of the blocks; empty: all packs."""
    first: int = 0
    """Smallest number of a block; used with ``pack``."""

    def __call__(self, connection: sqlite3.Connection) -> list[StoredBlock]:
        """Run the transaction."""
        condition = "pack = ? AND number >= ? ORDER BY number" if self.pack else "id > ? ORDER BY id"
        arguments = (self.pack, self.first) if self.pack else (self.after_id,)
        query = (
            "SELECT id, pack, number, data, (SELECT min(number) FROM block AS other WHERE other.pack = block.pack) "  # noqa: S608 - constant text
            f"FROM block WHERE {condition} LIMIT ?"
        )
        rows = connection.execute(query, (*arguments, self.max_blocks))
        return [
            StoredBlock(block_id, pack, number, with_oldest(data, oldest))
            for block_id, pack, number, data, oldest in rows
        ]
