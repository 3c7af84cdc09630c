"""Database with a failing disk, file or folder: one log line, operation in memory, recovery."""

import asyncio
import os
import shutil
import sqlite3
import stat
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import structlog

from bms_estimator.mqtt.connection import Message
from bms_estimator.store import database as database_module
from bms_estimator.store.database import FREE_PAGES, Database, StoreError
from bms_estimator.store.history import HistorySink
from bms_estimator.store.outbox import Outbox
from tests.patience import LONG_S
from tests.sinks.snapshots import CELL_SNAPSHOT


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "pack.sqlite"


def insert_message(number: int) -> Callable[[sqlite3.Connection], Any]:
    """Return a transaction that inserts a message of 100 kB into the table of the outbox."""

    def insert(connection: sqlite3.Connection) -> None:
        connection.execute("INSERT INTO outbox VALUES (?, 't', zeroblob(100000), 1, 0)", (number,))

    return insert


def message_numbers(connection: sqlite3.Connection) -> list[int]:
    """Return the numbers of the messages in the table of the outbox."""
    return [number for (number,) in connection.execute("SELECT number FROM outbox ORDER BY number")]


async def test_files_are_readable_only_by_their_owner(path):
    path.touch(mode=0o644)
    async with Database(path) as database:
        await database.call(insert_message(1))
        assert {each.name for each in path.parent.iterdir()} == {path.name, f"{path.name}-wal", f"{path.name}-shm"}
        assert {stat.S_IMODE(each.stat().st_mode) for each in path.parent.iterdir()} == {0o600}


async def test_failed_transaction_is_rolled_back(path):
    def insert_and_fail(connection: sqlite3.Connection) -> None:
        insert_message(1)(connection)
        raise sqlite3.OperationalError("half way")

    async with Database(path, retry_s=0.0) as database:
        with pytest.raises(StoreError, match="half way"):
            await database.call(insert_and_fail)
        assert await database.call(message_numbers) == []


@pytest.mark.parametrize("suffix", ["", "-wal", "-shm"])
async def test_symlink_at_the_path_of_a_file_is_not_followed(path, suffix):
    target = path.with_name("target")
    target.write_bytes(b"precious")
    path.with_name(path.name + suffix).symlink_to(target)
    async with Database(path) as database:
        await database.call(insert_message(1))
        assert await database.call(message_numbers) == [1]
    assert target.read_bytes() == b"precious"


async def test_file_that_is_no_database_is_quarantined_and_replaced(path):
    path.write_bytes(os.urandom(10_000))
    damaged = path.read_bytes()
    with structlog.testing.capture_logs() as logs:
        async with Database(path) as database:
            await database.call(insert_message(1))
    assert path.with_name("pack.refused.sqlite").read_bytes() == damaged
    assert [line["event"] for line in logs] == ["database set aside, a new one is begun"]


async def test_damaged_database_is_quarantined(path):
    async with Database(path) as database:
        for number in range(50):
            await database.call(insert_message(number))
    with path.open("r+b") as file:
        file.seek(4096)  # overwrites all pages except the first and the last
        file.write(b"\xff" * (path.stat().st_size - 8192))
    async with Database(path) as database:
        assert await database.call(message_numbers) == []
    assert path.with_name("pack.refused.sqlite").exists()


async def test_database_of_a_later_version_is_quarantined_unchanged(path):
    with sqlite3.connect(path) as connection:
        connection.execute("PRAGMA user_version = 99")
    connection.close()
    async with Database(path) as database:
        assert await database.call(message_numbers) == []
    with sqlite3.connect(path.with_name("pack.refused.sqlite")) as connection:
        assert connection.execute("PRAGMA user_version").fetchone() == (99,)
    connection.close()


def modify(path: Path, script: str) -> None:
    """Run an SQL script on the database."""
    with sqlite3.connect(path) as connection:
        connection.executescript(script)
    connection.close()


@pytest.mark.parametrize(
    "damage",
    [
        lambda path: modify(path, "PRAGMA user_version = 0"),
        lambda path: modify(path, "ALTER TABLE outbox RENAME COLUMN topic TO tooic"),
        lambda path: modify(path, "DROP TABLE minute"),
        lambda path: path.write_bytes(path.read_bytes().replace(b"TABLE minute", b"TABLE\xffminute")),
        # offset 18: a write version that makes the file read-only; offset 47: schema format
        lambda path: path.write_bytes(path.read_bytes()[:18] + b"\x42" + path.read_bytes()[19:]),
        lambda path: path.write_bytes(path.read_bytes()[:47] + b"\x44" + path.read_bytes()[48:]),
    ],
)
async def test_database_with_another_schema_is_quarantined(path, damage):
    async with Database(path) as database:
        await database.call(insert_message(1))
    damage(path)
    async with Database(path) as database:
        await database.call(insert_message(2))
        assert await database.call(message_numbers) == [2]
    assert path.with_name("pack.refused.sqlite").exists()


async def test_full_disk_is_logged_once_and_used_again_once_it_has_space(full_disk):
    with structlog.testing.capture_logs() as logs:
        async with Database(full_disk / "pack.sqlite", retry_s=0.0) as database:
            for _ in range(3):
                with pytest.raises(StoreError):
                    await database.call(insert_message(1))
            assert database.failure_reason
            os.system(f"mount -o remount,size=4m {full_disk}")  # noqa: ASYNC221
            await database.call(insert_message(1))
            assert (database.failure_reason, await database.call(message_numbers)) == ("", [1])
    assert [line["log_level"] for line in logs] == ["warning", "info"]


async def test_after_a_failure_transactions_fail_at_once_until_the_retry_time(path):
    calls = 0

    def fail(_: sqlite3.Connection) -> None:
        nonlocal calls
        calls += 1
        raise sqlite3.OperationalError("broken")

    async with Database(path, retry_s=1e6) as database:
        for _ in range(3):
            with pytest.raises(StoreError, match="broken"):
                await database.call(fail)
    assert calls == 1


async def test_deleted_folder_is_recreated(tmp_path):
    path = tmp_path / "state" / "pack.sqlite"
    async with Database(path) as database:
        await database.call(insert_message(1))
        shutil.rmtree(path.parent)
        await database.call(insert_message(2))
        assert await database.call(message_numbers) == [2]
    assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700


async def test_hung_disk_does_not_block_callers_and_is_used_again_once_it_answers(path):
    may_return = threading.Event()
    async with Database(path, disk_timeout_s=0.05, retry_s=0.0) as database:
        with pytest.raises(StoreError, match="has not answered"):
            await database.call(lambda _: may_return.wait(LONG_S))
        with pytest.raises(StoreError, match="has not answered"):
            await database.call(message_numbers)  # fails at once, without a disk access
        may_return.set()
        async with asyncio.timeout(LONG_S):
            while database.failure_reason:
                try:
                    await database.call(message_numbers)
                except StoreError:
                    await asyncio.sleep(0.01)


async def test_shutdown_with_a_hung_disk_has_one_deadline_for_the_writes_of_all_its_users(path, monkeypatch):
    monkeypatch.setattr(database_module, "SHUTDOWN_TIMEOUT_S", 0.05)
    may_return = threading.Event()
    async with asyncio.timeout(LONG_S):
        async with Database(path, disk_timeout_s=10 * LONG_S) as database:
            async with Outbox(database, max_messages=10) as outbox, HistorySink(database, days=1) as history:
                hung = asyncio.create_task(database.call(lambda _: may_return.wait(2 * LONG_S)))
                history.publish(CELL_SNAPSHOT)
                outbox.put(Message("t", b"", 1, retain=False))
            with pytest.raises(StoreError, match="has not answered"):
                await hung
    may_return.set()


async def test_internal_error_of_a_transaction_is_raised_and_leaves_the_database_usable(path):
    async with Database(path) as database:
        with pytest.raises(KeyError):
            await database.call(lambda _: {}["x"])
        assert await database.call(message_numbers) == []


async def test_free_pages_are_returned_to_the_file_system(path):
    async with Database(path) as database:
        for number in range(400):
            await database.call(insert_message(number))
        # ``and None``: a cursor must not leave the thread of the database
        await database.call(lambda connection: connection.execute("DELETE FROM outbox") and None)
        for _ in range(5):  # each transaction returns a part of the free pages
            await database.call(message_numbers)
    assert path.stat().st_size <= 4096 * (FREE_PAGES + 100)  # up to 100 pages in use


HUNG_DISK_SCRIPT = """
import asyncio, pathlib, sys, threading
from bms_estimator.store.database import Database, StoreError

async def main():
    async with Database(pathlib.Path(sys.argv[1]), disk_timeout_s=0.05) as database:
        try:
            await database.call(lambda _: threading.Event().wait())
        except StoreError as error:
            print(error)

asyncio.run(main())
"""


def test_process_ends_although_the_disk_hangs(path):
    process = subprocess.run(
        [sys.executable, "-c", HUNG_DISK_SCRIPT, path], timeout=LONG_S, capture_output=True, check=True
    )
    assert b"has not answered" in process.stdout
