"""Block queue of an edge: numbers, limits, and recovery after kills, damage and a full disk."""

import asyncio
import contextlib
import os
import sqlite3
import subprocess
import sys
import threading
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from structlog.testing import capture_logs

from bms_estimator.edge.batching import ReadyBlock
from bms_estimator.edge.block import Block, decode, encode
from bms_estimator.edge.block_queue import BlockQueue
from bms_estimator.edge.block_sender import PACK
from bms_estimator.edge.block_table import EDGE_TABLES, INGEST_TABLES, NS_PER_S
from bms_estimator.edge.subjects import BlockRequest
from bms_estimator.model.arrays import SAMPLE
from bms_estimator.store.database import Database, StoreError
from bms_estimator.store.migrations import migrate
from tests.patience import LONG_S

WALL_S = 1.7e9
"""Wall clock at the creation of the store [s since 1970]."""


def block_at(at_s: float, count: int = 5) -> ReadyBlock:
    """Return a block of ``count`` samples at 1 Hz from ``at_s`` on [s since 1970], with different voltages."""
    samples = np.zeros(count, dtype=SAMPLE)
    samples["time_s"] = at_s + np.arange(count)
    samples["voltage_v"] = samples["time_s"] - WALL_S
    return ReadyBlock(at_s + count, samples)


@contextlib.asynccontextmanager
async def open_queue(path: Path, tables: tuple[str, ...] = EDGE_TABLES, **limits: float) -> AsyncIterator[BlockQueue]:
    """Open the queue of blocks at ``path`` with some limits."""
    async with Database(path, tables=tables, sync_s=0.0, retry_s=0.0) as database:
        queue = BlockQueue(database, "raw/{}".format, **{"resend_s": 0.0} | limits)
        await queue.sync()
        yield queue
        await queue.sync()


async def write_blocks(queue: BlockQueue, *blocks: ReadyBlock, pack: str = PACK) -> None:
    """Write blocks to disk."""
    for block in blocks:
        queue.put(pack, block)
    assert await queue.sync()


async def fail_to_sync(queue: BlockQueue) -> None:
    """Synchronize while the disk fails."""
    with mock.patch.object(queue._database, "call", side_effect=StoreError("the disk has failed")):
        assert not await queue.sync()


async def take(queue: BlockQueue, count: int, pack: str = PACK) -> list[Block]:
    """Return the next ``count`` blocks of a pack to be sent, which the broker does not acknowledge."""
    blocks = list[Block]()
    async with asyncio.timeout(LONG_S):
        while len(blocks) < count:
            messages = await queue.take(count - len(blocks))
            assert {queued.message.topic for queued in messages} == {f"raw/{pack}"}
            blocks += [decode(queued.message.payload) for queued in messages]
    return blocks


def acknowledge(queue: BlockQueue, *blocks: int) -> None:
    """Acknowledge blocks in flight, by their numbers."""
    for message, (_, number) in list(queue._in_flight.items()):
        if number in blocks:
            queue.acknowledge(message)


def numbers(blocks: list[Block]) -> list[int]:
    return [block.number for block in blocks]


def minute_blocks(count: int, first: int = 0) -> list[ReadyBlock]:
    """Return blocks at intervals of one minute, beginning ``first`` minutes after ``WALL_S``."""
    return [block_at(WALL_S + 60.0 * i) for i in range(first, first + count)]


async def test_blocks_are_taken_in_order_with_times_relative_to_the_store(tmp_path: Path) -> None:
    async with open_queue(tmp_path / "s.sqlite") as queue:
        ready = minute_blocks(4)
        await write_blocks(queue, *ready)
        blocks = await take(queue, 4)
        assert numbers(blocks) == [1, 2, 3, 4]
        assert {block.store_created_ns for block in blocks} == {int(WALL_S) * NS_PER_S}
        for block, original in zip(blocks, ready, strict=True):
            assert block.arrival_s == original.arrival_s
            assert (block.store_created_ns / NS_PER_S + block.samples["time_s"] == original.samples["time_s"]).all()
            assert (block.samples["voltage_v"] == original.samples["voltage_v"]).all()


async def test_restarted_edge_continues_numbers_and_time_of_the_store_and_sends_unacknowledged_blocks(
    tmp_path: Path,
) -> None:
    async with open_queue(tmp_path / "s.sqlite") as queue:
        await write_blocks(queue, *minute_blocks(6))
        await take(queue, 6)
        acknowledge(queue, 1, 2, 3, 4)
        queue.on_request(PACK, BlockRequest(store=int(WALL_S) * NS_PER_S, number=4, resend=False))
        assert (queue.waiting, queue.unconfirmed) == (2, 3)
        await fail_to_sync(queue)
    async with open_queue(tmp_path / "s.sqlite") as queue:
        assert queue.position(PACK).last_s == WALL_S + 304.0  # five samples from 300 s on
        await write_blocks(queue, block_at(WALL_S))  # a clock set back does not set back the time of the store
        blocks = await take(queue, 3)
    assert numbers(blocks) == [5, 6, 7]
    assert {block.store_created_ns for block in blocks} == {int(WALL_S) * NS_PER_S}
    assert {block.oldest for block in blocks} == {4}
    assert blocks[-1].samples["time_s"].tolist() == [304.0] * 5


async def test_full_store_drops_its_oldest_blocks_and_announces_the_oldest_remaining_one(tmp_path: Path) -> None:
    async with open_queue(tmp_path / "s.sqlite", max_bytes=60_000) as queue:
        with capture_logs() as lines:
            for i in range(400):
                await write_blocks(queue, block_at(WALL_S + 60.0 * i, count=50))
        assert [line["reason"] for line in lines if "lost" in line["event"]] == ["the store is full or damaged"]
        remaining = queue.unconfirmed
        assert queue.dropped == 400 - remaining
        blocks = await take(queue, remaining)
        assert numbers(blocks) == list(range(401 - remaining, 401))
        assert {block.oldest for block in blocks} == {401 - remaining}
        payload_bytes = sum(len(encode(block)) for block in blocks)
        assert 30_000 < payload_bytes <= 60_000  # the rest are fractions of pages


async def test_oldest_blocks_of_a_pack_beyond_its_limit_are_dropped_and_those_of_others_stay(tmp_path: Path) -> None:
    async with open_queue(tmp_path / "s.sqlite", INGEST_TABLES, max_blocks=2) as queue:
        await write_blocks(queue, *minute_blocks(2), pack="a")
        await write_blocks(queue, *minute_blocks(5), pack="b")
        assert (queue.unconfirmed_of("a"), queue.unconfirmed_of("b"), queue.dropped) == (2, 2, 3)
        assert numbers(await take(queue, 2, "a")) == [1, 2]
        assert numbers(await take(queue, 2, "b")) == [4, 5]
        queue.remove("b")
    async with open_queue(tmp_path / "s.sqlite", INGEST_TABLES) as queue:
        assert (queue.packs, queue.unconfirmed) == (["a"], 2)


@contextlib.asynccontextmanager
async def slow_sync(queue: BlockQueue) -> AsyncIterator[None]:
    """Synchronize with a disk that does not write before the end of the context."""
    is_ended = threading.Event()
    queue._database._thread.submit(is_ended.wait)
    syncing = asyncio.create_task(queue.sync())
    await asyncio.sleep(0)  # until the sync waits for the disk
    yield
    is_ended.set()
    assert await syncing


async def test_removal_of_a_pack_during_a_write_loses_no_block_of_another_one(tmp_path: Path) -> None:
    async with open_queue(tmp_path / "s.sqlite", INGEST_TABLES) as queue:
        removed, first, second = minute_blocks(3)
        queue.put("a", removed)
        queue.put("b", first)
        async with slow_sync(queue):
            queue.remove("a")
            queue.put("b", second)
        await queue.sync()
        assert (queue.packs, queue.unconfirmed, queue.dropped) == (["b"], 2, 0)
        assert numbers(await take(queue, 2, "b")) == [1, 2]


async def test_blocks_that_are_written_while_a_new_store_is_begun_are_written_to_the_new_store(tmp_path: Path) -> None:
    async with open_queue(tmp_path / "s.sqlite") as queue:
        await write_blocks(queue, *minute_blocks(2))
        queue.put(PACK, block_at(WALL_S + 120.0))
        async with slow_sync(queue):
            queue.on_request(PACK, BlockRequest(store=(int(WALL_S) + 9) * NS_PER_S, number=1, resend=False))
        await queue.sync()
        assert (queue.unconfirmed, queue.dropped) == (1, 2)
        (block,) = await take(queue, 1)
    assert (block.number, block.store_created_ns) == (1, (int(WALL_S) + 120) * NS_PER_S)


async def test_pack_that_is_removed_during_a_failing_write_stays_removed(tmp_path: Path) -> None:
    async with open_queue(tmp_path / "s.sqlite", INGEST_TABLES) as queue:
        queue.put("a", block_at(WALL_S))

        def fail(_: object) -> None:
            queue.remove("a")
            raise StoreError("the disk has failed")

        with mock.patch.object(queue._database, "call", side_effect=fail):
            assert not await queue.sync()
    async with open_queue(tmp_path / "s.sqlite", INGEST_TABLES) as queue:
        assert queue.packs == []


async def test_resend_of_a_pack_does_not_delay_the_others(tmp_path: Path) -> None:
    async with open_queue(tmp_path / "s.sqlite", INGEST_TABLES) as queue:
        for pack in ("a", "b"):
            await write_blocks(queue, *minute_blocks(4), pack=pack)
            await take(queue, 4, pack)
        queue.on_request("a", BlockRequest(store=int(WALL_S) * NS_PER_S, number=2, resend=True))
        await write_blocks(queue, *minute_blocks(1, first=4), pack="b")
        assert numbers(await take(queue, 1, "a")) == [2]
        assert numbers(await take(queue, 1, "b")) == [5]
        queue.resend_one("b", 3)
        assert numbers(await take(queue, 1, "b")) == [3]
        assert numbers(await take(queue, 2, "a")) == [3, 4]


async def test_transaction_whose_result_is_unknown_is_repeated_without_effect(tmp_path: Path) -> None:
    async with open_queue(tmp_path / "s.sqlite") as queue:
        call = queue._database.call

        async def call_without_result(work: Callable[[sqlite3.Connection], object]) -> None:
            await call(work)
            raise StoreError("the disk has not answered")

        queue.put(PACK, minute_blocks(1)[0])
        with mock.patch.object(queue._database, "call", call_without_result):
            assert not await queue.sync()
        await write_blocks(queue, *minute_blocks(1, first=1))
        assert numbers(await take(queue, 2)) == [1, 2]


async def test_blocks_that_the_broker_has_not_acknowledged_are_taken_again_after_a_rewind(tmp_path: Path) -> None:
    async with open_queue(tmp_path / "s.sqlite") as queue:
        await write_blocks(queue, *minute_blocks(6))
        await take(queue, 5)
        acknowledge(queue, 1, 2, 4)
        queue.rewind()
        assert numbers(await take(queue, 4)) == [3, 4, 5, 6]


async def test_resend_request_repeats_the_requested_block_and_all_later_ones(tmp_path: Path) -> None:
    async with open_queue(tmp_path / "s.sqlite") as queue:
        await write_blocks(queue, *minute_blocks(8))
        await take(queue, 8)
        queue.on_request(PACK, BlockRequest(store=int(WALL_S) * NS_PER_S, number=3, resend=True))
        blocks = await take(queue, 6)
        assert (numbers(blocks), {block.oldest for block in blocks}) == ([3, 4, 5, 6, 7, 8], {3})


async def test_repeated_resend_request_is_ignored_within_the_resend_interval(tmp_path: Path) -> None:
    async with open_queue(tmp_path / "s.sqlite") as queue:
        queue._resend_s = LONG_S
        await write_blocks(queue, *minute_blocks(8))
        await take(queue, 8)
        request = BlockRequest(store=int(WALL_S) * NS_PER_S, number=3, resend=True)
        queue.on_request(PACK, request)
        await take(queue, 6)
        queue.on_request(PACK, request)
        await write_blocks(queue, *minute_blocks(1, first=8))
        assert numbers(await take(queue, 1)) == [9]


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
    async with open_queue(tmp_path / "s.sqlite") as queue:
        await write_blocks(queue, *minute_blocks(3))
        await take(queue, 3)
        with capture_logs() as lines:
            for _ in range(2):
                queue.on_request(PACK, block_request)
        assert sum("a new store is begun" in line["event"] for line in lines) == 1
        await fail_to_sync(queue)
        await write_blocks(queue, block_at(WALL_S + 1000.0))
        (block,) = await take(queue, 1)
        assert (block.number, block.oldest) == (1, 1)
        assert block.store_created_ns > block_request.store
        assert block.store_created_ns / NS_PER_S + block.samples["time_s"][0] == WALL_S + 1000.0
        assert queue.dropped == 3
    with contextlib.closing(sqlite3.connect(tmp_path / "s.sqlite")) as connection:
        assert connection.execute("SELECT number FROM block").fetchall() == [(1,)]


@pytest.mark.parametrize("store_ns", [0, 5, (1 << 63) - 1])
async def test_request_with_an_implausible_store_is_ignored(tmp_path: Path, store_ns: int) -> None:
    async with open_queue(tmp_path / "s.sqlite") as queue:
        await write_blocks(queue, *minute_blocks(3))
        queue.on_request(PACK, BlockRequest(store=store_ns, number=1 << 63, resend=True))
        await write_blocks(queue, *minute_blocks(1, first=3))
        assert numbers(await take(queue, 4)) == [1, 2, 3, 4]


def encoded(number: int) -> bytes:
    """Return a block of the version before, encoded for the store of ``WALL_S``."""
    samples = block_at(60.0 * (number - 1)).samples
    return encode(Block(int(WALL_S) * NS_PER_S, number, number, WALL_S, samples))


async def test_unsent_blocks_of_an_edge_of_the_version_before_are_sent(tmp_path: Path) -> None:
    with contextlib.closing(sqlite3.connect(tmp_path / "s.sqlite", isolation_level=None)) as connection:
        migrate(connection, EDGE_TABLES[:1])
        connection.executemany("INSERT INTO block VALUES (?, ?)", [(number, encoded(number)) for number in (3, 4)])
        connection.execute("INSERT INTO store VALUES (?, 5, 184.0, 999, 'run', 4)", (int(WALL_S),))
    async with open_queue(tmp_path / "s.sqlite") as queue:
        await write_blocks(queue, block_at(WALL_S))
        blocks = await take(queue, 3)
    assert numbers(blocks) == [3, 4, 5]
    assert {(block.store_created_ns, block.oldest) for block in blocks} == {(int(WALL_S) * NS_PER_S, 3)}
    assert blocks[-1].samples["time_s"].tolist() == [184.0] * 5


async def test_unsent_blocks_and_progress_of_ingest_of_the_version_before_are_read(tmp_path: Path) -> None:
    with contextlib.closing(sqlite3.connect(tmp_path / "s.sqlite", isolation_level=None)) as connection:
        migrate(connection, INGEST_TABLES[:1])
        rows = [("a", 3), ("b", 1), ("a", 4), ("a", 5)]
        insert = "INSERT INTO block (pack, number, data) VALUES (?, ?, ?)"
        connection.executemany(insert, [(pack, number, encoded(number)) for pack, number in rows])
        packs = [
            ("a", int(WALL_S), 6, WALL_S + 244.0),
            ("b", int(WALL_S), 2, WALL_S + 4.0),
            ("c", int(WALL_S), 9, WALL_S),
        ]
        connection.executemany("INSERT INTO pack VALUES (?, ?, ?, ?)", packs)
        connection.execute("INSERT INTO progress VALUES ('now', 77, 3)")  # three blocks were acknowledged
    async with open_queue(tmp_path / "s.sqlite", INGEST_TABLES) as queue:
        assert queue.progress == ("now", 77)
        assert [queue.unconfirmed_of(pack) for pack in queue.packs] == [3, 1, 0]
        await write_blocks(queue, block_at(WALL_S + 300.0), pack="b")
        assert numbers(await take(queue, 1, "a")) == [5]
        assert numbers(await take(queue, 1, "b")) == [2]


@pytest.mark.parametrize("damage", ["no database", "deleted", "other tables", "row"])
async def test_damaged_or_deleted_database_is_replaced_by_a_new_store(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "s.sqlite"
    async with open_queue(path) as queue:
        await write_blocks(queue, *minute_blocks(3))
        created_s = queue.position(PACK).created_s
        queue.on_request(PACK, BlockRequest(store=created_s * NS_PER_S, number=3, resend=False))
    if damage == "no database":
        path.write_bytes(b"not an SQLite file" * 1000)
    elif damage == "deleted":
        path.unlink()
    else:
        with contextlib.closing(sqlite3.connect(path)) as connection:
            connection.execute("DROP TABLE block" if damage == "other tables" else "UPDATE pack SET next = 'x'")
            connection.commit()
    with capture_logs() as lines:
        async with open_queue(path) as queue:
            await write_blocks(queue, block_at(WALL_S + 500.0))
            (block,) = await take(queue, 1)
            queue.on_request(PACK, BlockRequest(store=block.store_created_ns, number=2, resend=False))
            assert await queue.sync()
            assert queue.unconfirmed == 0  # block 3 of the former store may remain on disk
            await write_blocks(queue, block_at(WALL_S + 560.0))
            assert numbers(await take(queue, 1)) == [2]
    assert block.store_created_ns > created_s * NS_PER_S
    assert block.number == 1
    quarantined = [line for line in lines if line["event"] == "database set aside, a new one is begun"]
    assert bool(quarantined) == (damage in ("no database", "other tables"))
    assert path.with_name("s.refused.sqlite").exists() == bool(quarantined)


async def test_file_deleted_while_in_use_loses_only_the_blocks_written_before(tmp_path: Path) -> None:
    async with open_queue(tmp_path / "s.sqlite", INGEST_TABLES) as queue:
        await write_blocks(queue, *minute_blocks(3), pack="a")
        await write_blocks(queue, *minute_blocks(1), pack="b")
        (tmp_path / "s.sqlite").unlink()
        await write_blocks(queue, *minute_blocks(2, first=3), pack="a")
        blocks = await take(queue, 2, "a")
        assert (numbers(blocks), {block.oldest for block in blocks}) == ([4, 5], {4})
        assert queue.dropped == 3
        await queue.sync()
    async with open_queue(tmp_path / "s.sqlite", INGEST_TABLES) as queue:
        assert {pack: queue.position(pack).next_number for pack in queue.packs} == {"a": 6, "b": 2}


async def test_damaged_blocks_are_skipped(tmp_path: Path) -> None:
    path = tmp_path / "s.sqlite"
    async with open_queue(path) as queue:
        await write_blocks(queue, *minute_blocks(6))
    with contextlib.closing(sqlite3.connect(path)) as connection:
        connection.execute("UPDATE block SET data = zeroblob(200) WHERE number = 1")
        connection.execute("UPDATE block SET data = substr(data, 1, 60) WHERE number = 4")
        connection.execute("DELETE FROM block WHERE number = 5")
        connection.commit()
    async with open_queue(path) as queue:
        blocks = await take(queue, 3)
        assert numbers(blocks) == [2, 3, 6]
        assert {block.oldest for block in blocks} == {2}  # block 2 is not yet confirmed and can be sent again
        await queue.sync()
        queue.on_request(PACK, BlockRequest(store=blocks[0].store_created_ns, number=2, resend=True))
        assert numbers(await take(queue, 3)) == [2, 3, 6]
        queue.on_request(PACK, BlockRequest(store=blocks[0].store_created_ns, number=4, resend=True))
        await queue.sync()
        (block,) = await take(queue, 1)
        assert (block.number, block.oldest, queue.dropped) == (6, 6, 3)  # 1, 4 and 5 are lost


async def test_blocks_wait_in_memory_without_a_number_while_the_disk_is_full(full_disk: Path) -> None:
    async with open_queue(full_disk / "s.sqlite") as queue:
        for block in minute_blocks(3):
            queue.put(PACK, block)
        assert not await queue.sync()
        assert (queue.unconfirmed, queue.waiting) == (3, 3)
        (full_disk / "file").unlink()
        await asyncio.to_thread(subprocess.run, ["mount", "-o", "remount,size=10m", full_disk], check=True)
        assert await queue.sync()
        assert numbers(await take(queue, 3)) == [1, 2, 3]


async def test_memory_is_bounded_while_the_disk_fails(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("a file in place of the folder")
    async with open_queue(tmp_path / "file" / "s.sqlite", max_unwritten=500_000) as queue:
        for i in range(60):
            queue.put(PACK, block_at(WALL_S + 60.0 * i, count=20_000))
        assert not await queue.sync()
        assert (queue.unconfirmed, queue.dropped) == (25, 35)


WRITER_SCRIPT = """
import asyncio, sys
from pathlib import Path
from tests.edge.test_block_queue import minute_blocks, open_queue, write_blocks
async def main():
    async with open_queue(Path(sys.argv[1])) as queue:
        for block in minute_blocks(10_000):
            await write_blocks(queue, block)
            print(queue.position('').next_number, file=sys.stderr, flush=True)
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
        async with open_queue(path) as queue:
            next_number = queue.position(PACK).next_number
            assert next_number >= reported
            assert numbers(await take(queue, queue.unconfirmed)) == list(range(1, next_number))
