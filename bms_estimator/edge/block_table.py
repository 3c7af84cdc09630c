"""Tables of the blocks that no worker has confirmed, for one pack or for many, and the transactions on them."""

import math
import sqlite3
import zlib
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from bms_estimator.edge.batching import ReadyBlock
from bms_estimator.edge.block import HEADER_BYTES, MAX_NUMBER, Block, BlockError, decode_header, encode

NS_PER_S = 1_000_000_000
MAX_CREATED_S = MAX_NUMBER // NS_PER_S - 1
"""Latest creation time of a store, in the year 2262 [s since 1970]."""
MIN_CREATED_S = 1
"""Earliest creation time of a store [s since 1970]; 0 means that a pack has no store yet."""
_PACKS = """
    CREATE TABLE pack (
        name TEXT PRIMARY KEY, made_s INTEGER NOT NULL, next INTEGER NOT NULL, last_s REAL NOT NULL,
        sent INTEGER NOT NULL, oldest INTEGER NOT NULL
    ) WITHOUT ROWID;
    CREATE TABLE progress (stream TEXT NOT NULL, sequence INTEGER NOT NULL);
"""
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
    f"""
    ALTER TABLE block ADD COLUMN pack TEXT NOT NULL DEFAULT ''; {_PACKS}
    INSERT INTO pack SELECT '', made_s, next, made_s + last_s, 0, coalesce((SELECT min(number) FROM block), next) FROM store;
    DROP TABLE store;
    """,  # noqa: S608 - constant text
)
"""Statements that create the tables of an edge, one item for each version, in the format of ``store.migrations.MIGRATIONS``.
The name of its only pack is empty. The last version does not copy the blocks, because the disk may be full."""
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
    f"""
    ALTER TABLE pack RENAME TO former_pack; ALTER TABLE progress RENAME TO former_progress; {_PACKS}
    INSERT INTO pack SELECT name, made_s, next, last_s,
        coalesce((SELECT max(number) FROM block WHERE pack = name AND id <= (SELECT sent FROM former_progress)), 0),
        coalesce((SELECT min(number) FROM block WHERE pack = name), next) FROM former_pack;
    INSERT INTO progress SELECT stream, sequence FROM former_progress;
    DROP TABLE former_pack;
    DROP TABLE former_progress;
    """,  # noqa: S608 - constant text
)
"""Statements that create the tables of ``fleet ingest``. The last version of both has the same columns."""


class PackPosition(NamedTuple):
    """Row of table ``pack``: position of a pack in the blocks of its store."""

    created_s: int = 0
    """Creation time of the store [s since 1970]: whole seconds, so that sample times relative to it are exact. 0 before the
    first block, which creates the store at the time of its first sample."""
    next_number: int = 1
    """Number of the next block."""
    last_s: float = -math.inf
    """Time of the last sample in a block [s since 1970]. Later blocks begin at this time or later."""
    sent: int = 0
    """Largest number of a block that the server has acknowledged."""
    oldest: int = 1
    """Number of the oldest block that can still be sent; ``next_number`` without one."""


class Progress(NamedTuple):
    """Only row of table ``progress``, which an edge does not use."""

    stream: str = ""
    """Creation time of the stream ``TELEMETRY``, which identifies it."""
    sequence: int = 0
    """Stream sequence number up to which all accepted samples are in stored blocks."""


def read_state(connection: sqlite3.Connection) -> tuple[Progress, dict[str, PackPosition]]:
    """Return the progress, and the valid positions by pack.

    Raises:
        sqlite3.Error: The database cannot be read.
    """
    row = connection.execute("SELECT stream, sequence FROM progress").fetchone()
    rows = connection.execute("SELECT name, made_s, next, last_s, sent, oldest FROM pack")
    packs = {name: PackPosition(*position) for name, *position in rows if _is_position(position)}
    return Progress(*row) if row else Progress(), packs


def _is_position(row: Sequence[Any]) -> bool:
    if [*map(type, row)] != [int, int, float, int, int]:
        return False
    position = PackPosition(*row)
    is_plausible = (
        0 <= position.created_s <= MAX_CREATED_S and 1 <= position.oldest <= position.next_number < MAX_NUMBER
    )
    return is_plausible and 0 <= position.sent < position.next_number


def write_changes(
    connection: sqlite3.Connection,
    positions: Mapping[str, PackPosition],
    unwritten: Sequence[tuple[str, ReadyBlock]],
    removed: Collection[str],
    progress: Progress,
    *,
    max_blocks: int,
    max_bytes: float,
) -> dict[str, PackPosition]:
    """Insert blocks with numbers, and delete blocks that are confirmed or exceed a limit. A repetition has no further effect.

    Args:
        connection: Connection with an open transaction.
        positions: Positions before ``unwritten`` of all packs that have changed. Blocks before ``oldest`` are deleted.
        unwritten: Blocks to insert, by pack; sample times are seconds since 1970.
        removed: Packs whose blocks and position are removed, before blocks are inserted.
        progress: New content of table ``progress``.
        max_blocks: Maximum number of stored blocks of a pack.
        max_bytes: Maximum size of the database [bytes]. The newest block is always kept.

    Returns:
        The positions after the transaction.

    Raises:
        sqlite3.Error: The database cannot be written.
    """
    for pack in removed:
        connection.execute("DELETE FROM block WHERE pack = ?", (pack,))
        connection.execute("DELETE FROM pack WHERE name = ?", (pack,))
    after = dict(positions)
    for pack, ready in unwritten:
        after[pack] = _insert(connection, pack, after[pack], ready)
    first = [(pack, max(at.oldest, at.next_number - max_blocks)) for pack, at in after.items()]
    connection.executemany("DELETE FROM block WHERE pack = ? AND number < ?", first)
    oldest = "DELETE FROM block WHERE rowid = (SELECT min(rowid) FROM block) AND rowid < (SELECT max(rowid) FROM block)"
    while _used_bytes(connection) > max_bytes and connection.execute(oldest).rowcount:
        pass
    after = {pack: at._replace(oldest=_oldest(connection, pack, at.next_number)) for pack, at in after.items()}
    rows = ((pack, *position) for pack, position in after.items())
    connection.executemany("INSERT OR REPLACE INTO pack VALUES (?, ?, ?, ?, ?, ?)", rows)
    connection.execute("DELETE FROM progress")
    connection.execute("INSERT INTO progress VALUES (?, ?)", progress)
    return after


class BlockRange(NamedTuple):
    """Successive blocks of a pack."""

    pack: str
    created_s: int
    """Creation time of the store [s since 1970]."""
    first: int
    """Number of the first block."""
    end: int
    """Number after the last block."""


class Page(NamedTuple):
    """Undamaged blocks of a range, read from disk."""

    range: BlockRange
    """Blocks that were looked up."""
    blocks: dict[int, bytes]
    """Encoded blocks by number."""
    is_damaged: bool
    """True if damaged blocks were deleted."""
    oldest: int
    """Number of the pack's oldest block on disk; ``range.end`` without one."""


def read_pages(connection: sqlite3.Connection, ranges: Sequence[BlockRange], max_blocks: int) -> list[Page]:
    """Return at most ``max_blocks`` blocks, and delete damaged ones among them. Pages of the last ranges may be missing.

    Raises:
        sqlite3.Error: The database cannot be read or written.
    """
    pages, left = list[Page](), max_blocks
    query = "SELECT number, data FROM block WHERE pack = ? AND number >= ? AND number < ? ORDER BY number LIMIT ?"
    for each in ranges:
        rows = connection.execute(query, (each.pack, each.first, each.end, left)).fetchall()
        blocks = {number: data for number, data in rows if _is_valid(number, data)}
        damaged = [(each.pack, number) for number, _ in rows if number not in blocks]
        connection.executemany("DELETE FROM block WHERE pack = ? AND number = ?", damaged)
        looked_up = each if len(rows) < left else each._replace(end=rows[-1][0] + 1)
        pages.append(Page(looked_up, blocks, bool(damaged), _oldest(connection, each.pack, each.end)))
        left -= len(rows)
        if not left:
            break
    return pages


def _insert(connection: sqlite3.Connection, pack: str, position: PackPosition, ready: ReadyBlock) -> PackPosition:
    """Insert the next block of a pack, and return the position after it."""
    samples = ready.samples.copy()
    # sample times never decrease within a store, even if the clock was set back before a restart
    times_s = np.maximum(samples["time_s"], max(position.last_s, MIN_CREATED_S))
    created_s = position.created_s or int(times_s[0])
    samples["time_s"] = times_s - created_s
    number = position.next_number
    oldest = number  # replaced by the oldest number at the time of sending
    block = Block(created_s * NS_PER_S, number, oldest, ready.arrival_s, samples, ready.cells_v)
    insert = "INSERT OR REPLACE INTO block (pack, number, data) VALUES (?, ?, ?)"
    connection.execute(insert, (pack, number, encode(block)))
    return position._replace(created_s=created_s, next_number=number + 1, last_s=float(times_s[-1]))


def _used_bytes(connection: sqlite3.Connection) -> int:
    """Return the size of the database without free pages [bytes]."""
    pages, free, page_bytes = (
        connection.execute(f"PRAGMA {name}").fetchone()[0] for name in ("page_count", "freelist_count", "page_size")
    )
    return int((pages - free) * page_bytes)


def _oldest(connection: sqlite3.Connection, pack: str, end: int) -> int:
    """Return the number of a pack's oldest block before the number ``end``; ``end`` without one."""
    query = "SELECT coalesce(min(number), ?) FROM block WHERE pack = ? AND number < ?"
    (oldest,) = connection.execute(query, (end, pack, end)).fetchone()
    return int(oldest)


def _is_valid(number: int, data: Any) -> bool:
    """Return True if a row holds the undamaged block of its number, by its header and the checksum of its body."""
    if not isinstance(data, bytes):
        return False
    try:
        zlib.decompress(data[HEADER_BYTES:])
        return decode_header(data).number == number
    except (BlockError, zlib.error):
        return False
