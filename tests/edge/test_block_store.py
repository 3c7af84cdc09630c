"""Block store of an edge: numbers, limits, and recovery after kills, damage and a full disk."""

import asyncio
import contextlib
import os
import sqlite3
import subprocess
import sys
from collections.abc import AsyncIterator
from pathlib import Path

import numpy as np
import pytest
from structlog.testing import capture_logs

from bms_estimator.edge.batching import ReadyBlock
from bms_estimator.edge.block import Block, decode
from bms_estimator.edge.block_store import BlockStore
from bms_estimator.edge.block_table import EDGE_TABLES, NS_PER_S
from bms_estimator.edge.subjects import BlockRequest
from bms_estimator.model.arrays import SAMPLE
from bms_estimator.store.database import Database
from tests.patience import LONG_S, until

WALL_S = 1.7e9
"""Wall clock at the creation of the store [s since 1970]."""
UNLIMITED_BYTES = 1 << 30
"""Size limit that no test reaches [bytes]."""


def block_at(at_s: float, count: int = 5) -> ReadyBlock:
    """Return a block of ``count`` samples at 1 Hz from ``at_s`` on [s since 1970], with different voltages."""
    samples = np.zeros(count, dtype=SAMPLE)
    samples["time_s"] = at_s + np.arange(count)
    samples["voltage_v"] = samples["time_s"] - WALL_S
    return ReadyBlock(at_s + count, samples)


@contextlib.asynccontextmanager
async def open_store(path: Path, max_bytes: int = UNLIMITED_BYTES, wall_s: float = WALL_S) -> AsyncIterator[BlockStore]:
    """Open the store of blocks at ``path``, with a wall clock that stands at ``wall_s``."""
    database = Database(path, tables=EDGE_TABLES, sync_s=0.0, retry_s=0.0)
    store = BlockStore(database, "raw/pack", max_bytes, wall=lambda: wall_s, resend_s=0.0)
    async with database, store:
        yield store


async def write_blocks(store: BlockStore, *blocks: ReadyBlock) -> None:
    """Put blocks into the store and wait until they are on disk."""
    for block in blocks:
        store.put(block)
    await until(lambda: not store._waiting)


async def take(store: BlockStore, count: int) -> list[Block]:
    """Return the next ``count`` blocks to be sent, after a check of topic and numbers of their messages."""
    blocks = list[Block]()
    async with asyncio.timeout(LONG_S):
        while len(blocks) < count:
            messages = await store.take(count - len(blocks))
            assert {waiting.message.topic for waiting in messages} == {"raw/pack"}
            blocks += [decode(waiting.message.payload) for waiting in messages]
            assert [waiting.number for waiting in messages] == [block.number for block in blocks[-len(messages) :]]
    return blocks


def numbers(blocks: list[Block]) -> list[int]:
    return [block.number for block in blocks]


def minute_blocks(count: int, first: int = 0) -> list[ReadyBlock]:
    """Return blocks at intervals of one minute, beginning ``first`` minutes after ``WALL_S``."""
    return [block_at(WALL_S + 60.0 * i) for i in range(first, first + count)]


async def test_blocks_are_taken_in_order_with_times_relative_to_the_store(tmp_path: Path) -> None:
    async with open_store(tmp_path / "s.sqlite") as store:
        ready = minute_blocks(4)
        await write_blocks(store, *ready)
        blocks = await take(store, 4)
        assert numbers(blocks) == [1, 2, 3, 4]
        assert {block.store_created_ns for block in blocks} == {int(WALL_S) * NS_PER_S}
        for block, original in zip(blocks, ready, strict=True):
            assert block.arrival_s == original.arrival_s
            assert (block.store_created_ns / NS_PER_S + block.samples["time_s"] == original.samples["time_s"]).all()
            assert (block.samples["voltage_v"] == original.samples["voltage_v"]).all()


async def test_restarted_edge_continues_numbers_and_time_of_the_store_and_sends_unconfirmed_blocks(
    tmp_path: Path,
) -> None:
    async with open_store(tmp_path / "s.sqlite") as store:
        await write_blocks(store, *minute_blocks(6))
        for block in await take(store, 6):
            store.acknowledge(block.number)
        store.on_request(BlockRequest(store=int(WALL_S) * NS_PER_S, number=4, resend=False))
        assert (store.waiting, store.unconfirmed) == (0, 3)
    async with open_store(tmp_path / "s.sqlite", wall_s=WALL_S - 1e8) as store:
        assert store.last_s == WALL_S + 304.0  # five samples from 300 s on
        await write_blocks(store, block_at(WALL_S))  # a clock set back does not set back the time of the store
        blocks = await take(store, 4)
    assert numbers(blocks) == [4, 5, 6, 7]
    assert {block.store_created_ns for block in blocks} == {int(WALL_S) * NS_PER_S}
    assert {block.oldest for block in blocks} == {4}
    assert blocks[-1].samples["time_s"].tolist() == [304.0] * 5


async def test_full_store_drops_its_oldest_blocks_and_announces_the_oldest_remaining_one(tmp_path: Path) -> None:
    async with open_store(tmp_path / "s.sqlite") as store:
        await write_blocks(store, *minute_blocks(1))
        max_bytes = int(10.5 * store._on_disk.state.bytes)  # ten blocks and a half
    async with open_store(tmp_path / "s.sqlite", max_bytes=max_bytes) as store:
        with capture_logs() as lines:
            for block in minute_blocks(60, first=1):
                await write_blocks(store, block)
        assert [line["reason"] for line in lines if "lost" in line["event"]] == ["the store is full"]
        assert store._on_disk.state.bytes <= max_bytes
        remaining = store.unconfirmed  # of the blocks 1 to 61
        assert store.dropped == 61 - remaining
        blocks = await take(store, remaining)
        assert numbers(blocks) == list(range(62 - remaining, 62))
        assert {block.oldest for block in blocks} == {62 - remaining}
        assert 8 <= remaining <= 11  # the sizes of compressed blocks differ


async def test_blocks_that_the_broker_has_not_acknowledged_are_taken_again_after_a_rewind(tmp_path: Path) -> None:
    async with open_store(tmp_path / "s.sqlite") as store:
        await write_blocks(store, *minute_blocks(6))
        await take(store, 5)
        for number in (1, 2, 4):
            store.acknowledge(number)
        store.rewind()
        assert numbers(await take(store, 4)) == [3, 4, 5, 6]


async def test_resend_request_repeats_the_requested_block_and_all_later_ones(tmp_path: Path) -> None:
    async with open_store(tmp_path / "s.sqlite") as store:
        await write_blocks(store, *minute_blocks(8))
        await take(store, 8)
        store.on_request(BlockRequest(store=int(WALL_S) * NS_PER_S, number=3, resend=True))
        blocks = await take(store, 6)
        assert (numbers(blocks), {block.oldest for block in blocks}) == ([3, 4, 5, 6, 7, 8], {3})


async def test_repeated_resend_request_is_ignored_within_the_resend_interval(tmp_path: Path) -> None:
    async with open_store(tmp_path / "s.sqlite") as store:
        store._resend_s = LONG_S
        await write_blocks(store, *minute_blocks(8))
        await take(store, 8)
        request = BlockRequest(store=int(WALL_S) * NS_PER_S, number=3, resend=True)
        store.on_request(request)
        await take(store, 6)
        store.on_request(request)
        await write_blocks(store, *minute_blocks(1, first=8))
        assert numbers(await take(store, 1)) == [9]


@pytest.mark.parametrize(
    "block_request",
    [
        BlockRequest(store=(int(WALL_S) + 77) * NS_PER_S + 1, number=1, resend=False),
        BlockRequest(store=int(WALL_S) * NS_PER_S, number=100, resend=True),
    ],
    ids=["of a later store", "of a later number"],
)
async def test_request_for_blocks_later_than_those_on_disk_begins_a_new_store(
    tmp_path: Path, block_request: BlockRequest
) -> None:
    """A disk restored from a backup has fewer blocks than the worker has received."""
    async with open_store(tmp_path / "s.sqlite") as store:
        await write_blocks(store, *minute_blocks(3))
        await take(store, 3)
        store.on_request(block_request)
        await until(lambda: store._on_disk.state.created_s * NS_PER_S > block_request.store)
        await write_blocks(store, block_at(WALL_S + 1000.0))
        (block,) = await take(store, 1)
        assert (block.number, block.oldest) == (1, 1)
        assert block.store_created_ns > block_request.store
        assert block.store_created_ns / NS_PER_S + block.samples["time_s"][0] == WALL_S + 1000.0
        assert store.dropped == 3


@pytest.mark.parametrize("store_ns", [0, 5, (1 << 63) - 1])
async def test_request_with_an_implausible_store_is_ignored(tmp_path: Path, store_ns: int) -> None:
    async with open_store(tmp_path / "s.sqlite") as store:
        await write_blocks(store, *minute_blocks(3))
        store.on_request(BlockRequest(store=store_ns, number=1 << 63, resend=True))
        await write_blocks(store, *minute_blocks(1, first=3))
        assert numbers(await take(store, 4)) == [1, 2, 3, 4]


@pytest.mark.parametrize("damage", ["no database", "deleted", "other tables", "row"])
async def test_damaged_or_deleted_database_is_replaced_by_a_new_store(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "s.sqlite"
    async with open_store(path) as store:
        await write_blocks(store, *minute_blocks(3))
        created_s = store._on_disk.state.created_s
    if damage == "no database":
        path.write_bytes(b"not an SQLite file" * 1000)
    elif damage == "deleted":
        path.unlink()
    else:
        with contextlib.closing(sqlite3.connect(path)) as connection:
            connection.execute("DROP TABLE block" if damage == "other tables" else "UPDATE store SET next = 'x'")
            connection.commit()
    with capture_logs() as lines:
        async with open_store(path, wall_s=WALL_S + 500.0) as store:
            await write_blocks(store, block_at(WALL_S + 500.0))
            (block,) = await take(store, 1)
    assert block.store_created_ns > created_s * NS_PER_S
    assert block.number == 1
    quarantined = [line for line in lines if line["event"] == "database set aside, a new one is begun"]
    assert bool(quarantined) == (damage in ("no database", "other tables"))
    assert path.with_name("s.refused.sqlite").exists() == bool(quarantined)


async def test_file_deleted_while_in_use_loses_only_the_blocks_written_before(tmp_path: Path) -> None:
    async with open_store(tmp_path / "s.sqlite") as store:
        await write_blocks(store, *minute_blocks(3))
        (tmp_path / "s.sqlite").unlink()
        await write_blocks(store, *minute_blocks(2, first=3))
        blocks = await take(store, 2)
        assert numbers(blocks) == [1, 2]
        assert (
            blocks[0].store_created_ns == (int(WALL_S) + 180) * NS_PER_S
        )  # created at the first block after the deletion
        assert blocks[0].samples["time_s"][0] == 0.0


async def test_damaged_blocks_are_skipped(tmp_path: Path) -> None:
    path = tmp_path / "s.sqlite"
    async with open_store(path) as store:
        await write_blocks(store, *minute_blocks(6))
    with contextlib.closing(sqlite3.connect(path)) as connection:
        connection.execute("UPDATE block SET data = zeroblob(200) WHERE number IN (1, 4)")
        connection.execute("DELETE FROM block WHERE number = 5")
        connection.commit()
    async with open_store(path) as store:
        blocks = await take(store, 3)
        assert numbers(blocks) == [2, 3, 6]
        assert {block.oldest for block in blocks} == {2}  # block 2 is not yet confirmed and can be sent again
        store.on_request(BlockRequest(store=blocks[0].store_created_ns, number=2, resend=True))
        assert numbers(await take(store, 3)) == [2, 3, 6]
        store.on_request(BlockRequest(store=blocks[0].store_created_ns, number=4, resend=True))
        (block,) = await take(store, 1)
        assert (block.number, block.oldest, store.dropped) == (6, 6, 3)  # 1, 4 and 5 are lost


async def test_blocks_wait_in_memory_without_a_number_while_the_disk_is_full(full_disk: Path) -> None:
    async with open_store(full_disk / "s.sqlite") as store:
        for block in minute_blocks(3):
            store.put(block)
        await until(lambda: store._database.failure_reason)
        assert (store.unconfirmed, store.waiting) == (3, 3)
        (full_disk / "file").unlink()
        await asyncio.to_thread(subprocess.run, ["mount", "-o", "remount,size=10m", full_disk], check=True)
        blocks = await take(store, 3)
        assert numbers(blocks) == [1, 2, 3]


async def test_memory_is_bounded_while_the_disk_fails(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("a file in place of the folder")
    async with open_store(tmp_path / "file" / "s.sqlite") as store:
        for i in range(60):
            store.put(block_at(WALL_S + 60.0 * i, count=20_000))
        assert store.unconfirmed == 25  # 500,000 samples, the limit of memory
        assert store.dropped == 35


WRITER_SCRIPT = """
import asyncio, sys
from pathlib import Path
from tests.edge.test_block_store import minute_blocks, open_store, write_blocks
async def main():
    async with open_store(Path(sys.argv[1])) as store:
        for block in minute_blocks(10_000):
            await write_blocks(store, block)
            print(store._on_disk.state.next_number, file=sys.stderr, flush=True)
asyncio.run(main())
"""


def kill_while_writing(path: Path) -> int:
    """Kill a process that writes blocks. Return the next block number by the last complete line of its output."""
    command, environment = [sys.executable, "-c", WRITER_SCRIPT, str(path)], os.environ | {"PYTHONPATH": "."}
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, env=environment) as process:
        assert process.stderr
        lines = [process.stderr.readline() for _ in range(20)]
        process.kill()
        lines += process.stderr.readlines()
    return int(lines[-1] if lines[-1].endswith(b"\n") else lines[-2])


async def test_killed_edge_never_uses_a_block_number_twice(tmp_path: Path) -> None:
    path, next_number = tmp_path / "s.sqlite", 0
    for _ in range(3):
        reported = await asyncio.to_thread(kill_while_writing, path)
        assert reported >= next_number + 20
        async with open_store(path) as store:
            next_number = store._on_disk.state.next_number
            assert next_number >= reported
            assert numbers(await take(store, store.unconfirmed)) == list(range(1, next_number))
