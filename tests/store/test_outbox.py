"""Outbox: order, and no loss except from a full queue."""

import asyncio
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from bms_estimator.mqtt.connection import Message
from bms_estimator.store import outbox as outbox_module
from bms_estimator.store.database import Database, StoreError
from bms_estimator.store.outbox import Outbox
from bms_estimator.store.outbox_queue import MAX_TAIL
from tests.patience import LONG_S, until


def numbered_message(number: int) -> Message:
    """Return a message whose payload is the number."""
    return Message("bms/pack/state", str(number).encode(), 1, retain=False)


def filled_outbox(count: int, *, max_messages: int = 100) -> Outbox:
    """Return an outbox without a database that contains the messages 0 to ``count`` - 1."""
    outbox = Outbox(None, max_messages=max_messages)
    for number in range(count):
        outbox.put(numbered_message(number))
    return outbox


async def take_numbers(outbox: Outbox, max_messages: int) -> list[int]:
    """Take messages. Return the numbers in their payloads."""
    async with asyncio.timeout(LONG_S):
        return [int(waiting.message.payload) for waiting in await outbox.take(max_messages)]


async def test_messages_are_taken_once_and_in_order():
    outbox = filled_outbox(5)
    assert await take_numbers(outbox, 2) == [0, 1]
    assert await take_numbers(outbox, 9) == [2, 3, 4]
    assert outbox.waiting == 5


async def test_unacknowledged_messages_are_taken_again_before_newer_ones():
    outbox = filled_outbox(3)
    first, *_ = await outbox.take(3)
    outbox.acknowledge(first.number)
    outbox.put(numbered_message(3))
    outbox.rewind()
    assert await take_numbers(outbox, 9) == [1, 2, 3]
    assert outbox.waiting == 3


async def test_take_waits_for_a_message():
    outbox = filled_outbox(0)
    task = asyncio.create_task(take_numbers(outbox, 1))
    await asyncio.sleep(0)
    assert not task.done()
    outbox.put(numbered_message(7))
    assert await task == [7]


async def test_full_queue_drops_and_counts_the_oldest_message_not_in_flight():
    outbox = filled_outbox(3, max_messages=3)
    assert await take_numbers(outbox, 1) == [0]
    outbox.put(numbered_message(3))
    outbox.put(numbered_message(4))
    assert outbox.dropped == 2
    assert await take_numbers(outbox, 9) == [3, 4]
    outbox.rewind()
    assert await take_numbers(outbox, 9) == [0, 3, 4]


class CountingDatabase(Database):
    """Database that counts its transactions."""

    calls = 0

    async def call(self, work: Callable[[sqlite3.Connection], Any]) -> Any:
        self.calls += 1
        return await super().call(work)


@pytest.fixture
def path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the path of a database, to which the outbox then writes every 10 ms."""
    monkeypatch.setattr(outbox_module, "FLUSH_S", 0.01)
    return tmp_path / "pack.sqlite"


def numbers_on_disk(path: Path) -> list[int]:
    """Return the numbers of the messages in the database."""
    try:
        with closing(sqlite3.connect(f"{path.as_uri()}?mode=ro", uri=True)) as connection:
            return [int(payload) for (payload,) in connection.execute("SELECT payload FROM outbox ORDER BY number")]
    except sqlite3.Error:
        return []  # the table does not exist yet


async def test_nothing_is_written_while_the_broker_acknowledges(path):
    async with CountingDatabase(path) as database, Outbox(database, max_messages=100) as outbox:
        outbox.connected = True
        for number in range(50):
            outbox.put(numbered_message(number))
            [waiting] = await outbox.take(9)
            outbox.acknowledge(waiting.number)
            # until the outbox has decided at the end of an interval whether to write
            await until(lambda number=number: number + 1 in outbox._next_numbers)
    assert database.calls == 1, "the backlog of an earlier run is read"
    assert numbers_on_disk(path) == []


async def test_messages_that_a_connected_broker_does_not_acknowledge_are_written(path):
    async with Database(path) as database, Outbox(database, max_messages=100) as outbox:
        outbox.connected = True
        outbox.put(numbered_message(0))
        await outbox.take(1)
        await until(lambda: numbers_on_disk(path) == [0])


async def test_messages_of_an_earlier_run_precede_newer_ones(path):
    async with Database(path) as database, Outbox(database, max_messages=100) as outbox:
        for number in range(5):
            outbox.put(numbered_message(number))
        first, *_ = await outbox.take(2)
        outbox.acknowledge(first.number)
    async with Database(path) as database, Outbox(database, max_messages=100) as outbox:
        outbox.put(numbered_message(5))
        received: list[int] = []
        while len(received) < 5:
            received += await take_numbers(outbox, 99)
    assert received == [1, 2, 3, 4, 5]


async def test_backlog_beyond_memory_is_read_from_disk_in_order(path):
    count = 3 * MAX_TAIL
    received: list[int] = []
    async with Database(path) as database, Outbox(database, max_messages=10 * count) as outbox:
        for number in range(count):
            outbox.put(numbered_message(number))
            if number % 1000 == 0:
                await until(lambda number=number: numbers_on_disk(path)[-1:] == [number])
        await until(lambda: len(numbers_on_disk(path)) == count)
        while len(received) < count:
            async with asyncio.timeout(LONG_S):
                for waiting in await outbox.take(50):
                    received.append(int(waiting.message.payload))
                    outbox.acknowledge(waiting.number)
        await until(lambda: numbers_on_disk(path) == [])
    assert received == list(range(count))
    assert (outbox.dropped, outbox.waiting) == (0, 0)


async def test_hung_disk_does_not_delay_messages_which_are_written_once_it_answers(path):
    may_return = threading.Event()
    async with (
        Database(path, disk_timeout_s=0.05, retry_s=0.0) as database,
        Outbox(database, max_messages=100) as outbox,
    ):
        await until(lambda: outbox._backlog_read)
        hung = asyncio.create_task(database.call(lambda _: may_return.wait(LONG_S)))
        for number in range(5):
            outbox.put(numbered_message(number))
        assert await take_numbers(outbox, 9) == [0, 1, 2, 3, 4]
        with pytest.raises(StoreError):
            await hung
        may_return.set()
        await until(lambda: numbers_on_disk(path) == [0, 1, 2, 3, 4])


async def test_start_with_a_hung_disk_sends_new_messages(path):
    may_return = threading.Event()
    async with Database(path, disk_timeout_s=0.05, retry_s=0.0) as database:
        hung = asyncio.create_task(database.call(lambda _: may_return.wait(LONG_S)))
        async with Outbox(database, max_messages=100) as outbox:
            outbox.put(numbered_message(0))
            assert await take_numbers(outbox, 9) == [0]
            may_return.set()
            with pytest.raises(StoreError):
                await hung


async def test_deleted_database_loses_and_counts_only_messages_that_were_not_in_memory(path):
    """A page of a thousand messages is in memory."""
    async with Database(path) as database, Outbox(database, max_messages=10_000) as outbox:
        for number in range(1500):
            outbox.put(numbered_message(number))
        await until(lambda: len(outbox._queue.stored) == 500)
        for file in path.parent.iterdir():
            file.unlink()
        outbox.put(numbered_message(1500))
        await until(lambda: outbox.dropped == 500)
        assert [*await take_numbers(outbox, 1000), *await take_numbers(outbox, 1000)] == [*range(1000), 1500]
        await until(lambda: len(numbers_on_disk(path)) == 1001)


class BrokenDatabase(Database):
    """Database with an internal error."""

    async def call(self, _: Callable[[sqlite3.Connection], Any]) -> Any:
        raise KeyError("internal")


async def put_forever(outbox: Outbox) -> None:
    async with asyncio.timeout(LONG_S):
        while True:
            outbox.put(numbered_message(0))
            await asyncio.sleep(0)


async def test_internal_error_of_the_writing_task_is_raised(path):
    outbox = await Outbox(BrokenDatabase(path), max_messages=100).__aenter__()
    with pytest.raises(KeyError, match="internal"):
        await put_forever(outbox)


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("topic", "'bms/+/state'"),
        ("topic", "'bms/pack/#'"),
        ("topic", "CAST(x'626d73ff' AS TEXT)"),  # "bms" and a byte that is not UTF-8
        ("topic", "CAST(x'626d7300' AS TEXT)"),  # "bms" and a null character
        ("topic", "'bms' || char(7)"),
        ("topic", "''"),
        ("topic", "hex(zeroblob(40000))"),  # longer than MQTT allows
        ("topic", "x'626d73'"),  # a blob instead of a text
        ("payload", "'text'"),
        ("qos", "5"),
        ("retain", "'no'"),
        ("number", "1 << 62"),
        ("number", "-9223372036854775807 - 1"),
    ],
)
async def test_damaged_row_is_skipped_and_counted(path, column, value):
    async with Database(path) as database, Outbox(database, max_messages=100) as outbox:
        for number in range(3):
            outbox.put(numbered_message(number))
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute(f"UPDATE outbox SET {column} = {value} WHERE payload = CAST('1' AS BLOB)")
    async with Database(path) as database, Outbox(database, max_messages=100) as outbox:
        outbox.put(numbered_message(3))
        received: list[int] = []
        while len(received) < 3:
            received += await take_numbers(outbox, 9)
        assert (received, outbox.dropped, database.failure_reason) == ([0, 2, 3], 1, "")
    assert numbers_on_disk(path) == [0, 2, 3]


async def test_memory_is_bounded_while_the_disk_fails(path):
    async with Database(path, retry_s=0.0) as database:
        outbox = Outbox(database, max_messages=100_000)
        await outbox._sync(write=False)
        path.unlink()
        path.mkdir()
        (path / "file").touch()
        # otherwise the folder at the path would be renamed
        database._file._quarantine_non_regular = lambda _: None  # type: ignore[method-assign]
        for number in range(3 * MAX_TAIL):
            outbox.put(numbered_message(number))
            if number % 1000 == 0:
                await outbox._sync(write=True)
        assert outbox.dropped == 2 * MAX_TAIL
        assert len(outbox._queue._written) <= MAX_TAIL
        assert len(outbox._queue.gaps()) == 1
        (path / "file").unlink()
        path.rmdir()


PUBLISHER_SCRIPT = """
import asyncio, sys
from pathlib import Path
from bms_estimator.sinks.mqtt.messages import Message
from bms_estimator.store.database import Database
from bms_estimator.store.outbox import Outbox

async def main():
    async with Database(Path(sys.argv[1])) as database, Outbox(database, max_messages=100_000) as outbox:
        for number in range(100_000):
            outbox.put(Message("t", str(number).encode(), 1, False))
            print(number, flush=True)
            await asyncio.sleep(0.001)

asyncio.run(main())
"""


def test_kill_of_the_process_loses_only_unwritten_messages(tmp_path):
    path = tmp_path / "pack.sqlite"
    with subprocess.Popen([sys.executable, "-c", PUBLISHER_SCRIPT, path], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout
        stored_before_kill: list[int] = []
        while len(stored_before_kill) < 2:
            process.stdout.readline()
            stored_before_kill = numbers_on_disk(path)
        process.kill()
    stored = numbers_on_disk(path)
    assert stored == list(range(len(stored)))
    assert len(stored) >= len(stored_before_kill)
