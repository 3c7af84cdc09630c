"""Blocks on an edge's disk: numbers, limits, and what remains after a kill, damage or a full disk."""

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
from bms_estimator.edge.block_table import EDGE_TABLES, NS
from bms_estimator.edge.subjects import BlockRequest
from bms_estimator.model.sample import SAMPLE
from bms_estimator.store.database import Database
from tests.patience import LONG_S

WALL_S = 1.7e9
FAR = 1 << 30
"""More bytes than any test keeps."""


def gathered(at_s: float, count: int = 5) -> ReadyBlock:
    """Return samples that differ from each other."""
    samples = np.zeros(count, dtype=SAMPLE)
    samples["time_s"] = at_s + np.arange(count)
    samples["voltage_v"] = samples["time_s"] - WALL_S
    return ReadyBlock(at_s + count, samples)


@contextlib.asynccontextmanager
async def opened(path: Path, most_bytes: int = FAR, wall_s: float = WALL_S) -> AsyncIterator[BlockStore]:
    database = Database(path, tables=EDGE_TABLES, sync_s=0.0, retry_s=0.0)
    store = BlockStore(database, "raw/pack", most_bytes, wall=lambda: wall_s, resend_s=0.0)
    async with database, store:
        yield store


async def until(condition) -> None:
    async with asyncio.timeout(LONG_S):
        while not condition():  # noqa: ASYNC110 - counters have no event
            await asyncio.sleep(0.002)


async def written(store: BlockStore, *blocks: ReadyBlock) -> None:
    for block in blocks:
        store.put(block)
    await until(lambda: not store._waiting)


async def handed_out(store: BlockStore, count: int) -> list[Block]:
    blocks = list[Block]()
    async with asyncio.timeout(LONG_S):
        while len(blocks) < count:
            taken = await store.take(count - len(blocks))
            assert {waiting.message.topic for waiting in taken} == {"raw/pack"}
            blocks += [decode(waiting.message.payload) for waiting in taken]
            assert [waiting.number for waiting in taken] == [block.number for block in blocks[-len(taken) :]]
    return blocks


def numbers(blocks: list[Block]) -> list[int]:
    return [block.number for block in blocks]


def minutes(count: int, first: int = 0) -> list[ReadyBlock]:
    return [gathered(WALL_S + 60.0 * i) for i in range(first, first + count)]


async def test_blocks_come_in_order_with_their_times_since_the_store_was_made(tmp_path: Path) -> None:
    async with opened(tmp_path / "s.sqlite") as store:
        given = minutes(4)
        await written(store, *given)
        blocks = await handed_out(store, 4)
        assert numbers(blocks) == [1, 2, 3, 4]
        assert {block.store for block in blocks} == {int(WALL_S) * NS}
        for block, one in zip(blocks, given, strict=True):
            assert block.arrival_s == one.arrival_s
            assert (block.store / NS + block.samples["time_s"] == one.samples["time_s"]).all()
            assert (block.samples["voltage_v"] == one.samples["voltage_v"]).all()


async def test_a_restart_goes_on_with_store_number_and_time_and_sends_what_is_not_safe(tmp_path: Path) -> None:
    async with opened(tmp_path / "s.sqlite") as store:
        await written(store, *minutes(6))
        for block in await handed_out(store, 6):
            store.sent(block.number)
        store.on_request(BlockRequest(store=int(WALL_S) * NS, number=4, resend=False))
        assert (store.waiting, store.kept) == (0, 3)
    async with opened(tmp_path / "s.sqlite", wall_s=WALL_S - 1e8) as store:
        assert store.last_s == WALL_S + 304.0
        await written(store, gathered(WALL_S))  # whoever sets a clock back cannot set back the time of the store
        blocks = await handed_out(store, 4)
    assert numbers(blocks) == [4, 5, 6, 7]
    assert {block.store for block in blocks} == {int(WALL_S) * NS}
    assert {block.oldest for block in blocks} == {4}
    assert blocks[-1].samples["time_s"].tolist() == [304.0] * 5


async def test_of_too_many_bytes_the_oldest_go_and_the_rest_says_so(tmp_path: Path) -> None:
    async with opened(tmp_path / "s.sqlite") as store:
        await written(store, *minutes(1))
        size = store._settled.kept.bytes
    async with opened(tmp_path / "s.sqlite", most_bytes=10 * size + size // 2) as store:
        with capture_logs() as lines:
            for block in minutes(60, 1):
                await written(store, block)
        assert [line["reason"] for line in lines if "lost" in line["event"]] == ["there is no room for more"]
        assert store._settled.kept.bytes <= 10 * size + size // 2
        left = store.kept
        assert store.dropped == 61 - left
        blocks = await handed_out(store, left)
        assert numbers(blocks) == list(range(62 - left, 62))
        assert {block.oldest for block in blocks} == {62 - left}
        assert 8 <= left <= 11


async def test_a_connection_that_is_lost_has_what_was_not_acknowledged_sent_again(tmp_path: Path) -> None:
    async with opened(tmp_path / "s.sqlite") as store:
        await written(store, *minutes(6))
        await handed_out(store, 5)
        for number in (1, 2, 4):
            store.sent(number)
        store.rewind()
        assert numbers(await handed_out(store, 4)) == [3, 4, 5, 6]


async def test_a_worker_that_asks_is_sent_the_rest_again(tmp_path: Path) -> None:
    async with opened(tmp_path / "s.sqlite") as store:
        await written(store, *minutes(8))
        await handed_out(store, 8)
        store.on_request(BlockRequest(store=int(WALL_S) * NS, number=3, resend=True))
        blocks = await handed_out(store, 6)
        assert (numbers(blocks), {block.oldest for block in blocks}) == ([3, 4, 5, 6, 7, 8], {3})


async def test_what_was_asked_for_is_not_sent_again_at_once(tmp_path: Path) -> None:
    async with opened(tmp_path / "s.sqlite") as store:
        store._resend_s = LONG_S
        await written(store, *minutes(8))
        await handed_out(store, 8)
        asked = BlockRequest(store=int(WALL_S) * NS, number=3, resend=True)
        store.on_request(asked)
        await handed_out(store, 6)
        store.on_request(asked)
        await written(store, *minutes(1, 8))
        assert numbers(await handed_out(store, 1)) == [9]


@pytest.mark.parametrize(
    "awaits",
    [
        BlockRequest(store=(int(WALL_S) + 77) * NS + 1, number=1, resend=False),
        BlockRequest(store=int(WALL_S) * NS, number=100, resend=True),
    ],
    ids=["a later store", "a later number"],
)
async def test_a_disk_that_was_set_back_begins_a_store_that_counts(tmp_path: Path, awaits: BlockRequest) -> None:
    async with opened(tmp_path / "s.sqlite") as store:
        await written(store, *minutes(3))
        await handed_out(store, 3)
        store.on_request(awaits)
        await until(lambda: store._settled.kept.made_s * NS > awaits.store)
        await written(store, gathered(WALL_S + 1000.0))
        (block,) = await handed_out(store, 1)
        assert (block.number, block.oldest) == (1, 1)
        assert block.store > awaits.store
        assert block.store / NS + block.samples["time_s"][0] == WALL_S + 1000.0
        assert store.dropped == 3


@pytest.mark.parametrize("store_ns", [0, 5, (1 << 63) - 1])
async def test_a_store_that_cannot_be_is_not_believed(tmp_path: Path, store_ns: int) -> None:
    async with opened(tmp_path / "s.sqlite") as store:
        await written(store, *minutes(3))
        store.on_request(BlockRequest(store=store_ns, number=1 << 63, resend=True))
        await written(store, *minutes(1, 3))
        assert numbers(await handed_out(store, 4)) == [1, 2, 3, 4]


@pytest.mark.parametrize("damage", ["no database", "deleted", "other tables", "row"])
async def test_a_damaged_database_is_set_aside_and_a_later_store_begun(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "s.sqlite"
    async with opened(path) as store:
        await written(store, *minutes(3))
        before = store._settled.kept.made_s
    if damage == "no database":
        path.write_bytes(b"nothing of the kind" * 1000)
    elif damage == "deleted":
        path.unlink()
    else:
        with contextlib.closing(sqlite3.connect(path)) as connection:
            connection.execute("DROP TABLE block" if damage == "other tables" else "UPDATE store SET next = 'x'")
            connection.commit()
    with capture_logs() as lines:
        async with opened(path, wall_s=WALL_S + 500.0) as store:
            await written(store, gathered(WALL_S + 500.0))
            (block,) = await handed_out(store, 1)
    assert block.store > before * NS
    assert block.number == 1
    aside = [line for line in lines if line["event"] == "database set aside, a new one is begun"]
    assert bool(aside) == (damage in ("no database", "other tables"))
    assert path.with_name("s.refused.sqlite").exists() == bool(aside)


async def test_a_file_that_is_deleted_while_it_runs_costs_what_was_in_it(tmp_path: Path) -> None:
    async with opened(tmp_path / "s.sqlite") as store:
        await written(store, *minutes(3))
        (tmp_path / "s.sqlite").unlink()
        await written(store, *minutes(2, 3))
        blocks = await handed_out(store, 2)
        assert numbers(blocks) == [1, 2]
        assert blocks[0].store == (int(WALL_S) + 180) * NS
        assert blocks[0].samples["time_s"][0] == 0.0


async def test_a_damaged_block_is_given_up_and_those_behind_it_come(tmp_path: Path) -> None:
    path = tmp_path / "s.sqlite"
    async with opened(path) as store:
        await written(store, *minutes(6))
    with contextlib.closing(sqlite3.connect(path)) as connection:
        connection.execute("UPDATE block SET data = zeroblob(200) WHERE number IN (1, 4)")
        connection.execute("DELETE FROM block WHERE number = 5")
        connection.commit()
    async with opened(path) as store:
        blocks = await handed_out(store, 3)
        assert numbers(blocks) == [2, 3, 6]
        assert {block.oldest for block in blocks} == {2}  # of those no worker has said that they are safe
        store.on_request(BlockRequest(store=blocks[0].store, number=2, resend=True))
        assert numbers(await handed_out(store, 3)) == [2, 3, 6]
        store.on_request(BlockRequest(store=blocks[0].store, number=4, resend=True))
        (block,) = await handed_out(store, 1)
        assert (block.number, block.oldest, store.dropped) == (6, 6, 3)


async def test_a_full_disk_has_blocks_wait_in_memory_without_a_number(full_disk: Path) -> None:
    async with opened(full_disk / "s.sqlite") as store:
        for block in minutes(3):
            store.put(block)
        await until(lambda: store._database.reason)
        assert (store.kept, store.waiting) == (3, 3)
        (full_disk / "file").unlink()
        await asyncio.to_thread(subprocess.run, ["mount", "-o", "remount,size=10m", full_disk], check=True)
        blocks = await handed_out(store, 3)
        assert numbers(blocks) == [1, 2, 3]


async def test_what_a_disk_never_takes_is_bounded(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    async with opened(tmp_path / "file" / "s.sqlite") as store:
        store._database.path.parent.touch()
        for i in range(60):
            store.put(gathered(WALL_S + 60.0 * i, 20_000))
        assert store.kept == 25
        assert store.dropped == 35


KILLED = """
import asyncio, sys
from pathlib import Path
from tests.edge.test_block_store import FAR, minutes, opened, written
async def main():
    async with opened(Path(sys.argv[1])) as store:
        for block in minutes(10_000):
            await written(store, block)
            print(store._settled.kept.next, file=sys.stderr, flush=True)
asyncio.run(main())
"""


def killed_in_mid_write(path: Path) -> int:
    """Return the number after the last that a process reported as stored before it was killed while writing."""
    command, folder = [sys.executable, "-c", KILLED, str(path)], {"PYTHONPATH": "."}
    with subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, env=os.environ | folder
    ) as process:
        assert process.stderr
        said = [process.stderr.readline() for _ in range(20)]
        process.kill()
        said += process.stderr.readlines()
    return int(said[-1] if said[-1].endswith(b"\n") else said[-2])


async def test_a_number_is_never_given_twice_over_kills(tmp_path: Path) -> None:
    path, next_ = tmp_path / "s.sqlite", 0
    for _ in range(3):
        said = await asyncio.to_thread(killed_in_mid_write, path)
        assert said >= next_ + 20
        async with opened(path) as store:
            next_ = store._settled.kept.next
            assert next_ >= said
            assert numbers(await handed_out(store, store.kept)) == list(range(1, next_))
