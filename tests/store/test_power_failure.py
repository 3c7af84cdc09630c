"""Power failures at a database: its writes and fsyncs are traced, and the files are rebuilt as a disk may have them at each moment."""

import random
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest
from structlog.testing import capture_logs

from bms_estimator.store.database import Database
from tests.patience import LONG_S
from tests.store.test_database import message_numbers

MESSAGES = 20
WRITER = """
import asyncio, os, sys
from pathlib import Path
from bms_estimator.store.database import Database

def insert(number):
    def work(connection):
        connection.execute("PRAGMA wal_autocheckpoint = 20")  # so that the log is moved to the database several times
        connection.execute("INSERT INTO outbox VALUES (?, 't', randomblob(9000), 1, 0)", (number,))
    return work

async def main(folder, messages, sync_s):
    committed = os.open(folder / "committed", os.O_WRONLY | os.O_CREAT)
    async with Database(folder / "pack.sqlite", sync_s=sync_s) as database:
        for number in range(messages):
            await database.call(insert(number))
            os.write(committed, b"x")

asyncio.run(main(Path(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])))
"""
CALL = re.compile(
    r'(\w+)\((?:AT_FDCWD, )?(?:\d+<([^>]+)>|"([^"]+)")(?:, "([^"]*)")?(?:, (\d+))?(?:, (\d+))?[^)]*\) += \d'
)
"""Line of a traced call: name; path, either after the descriptor or as an argument; data; numbers. Paths and data are hexadecimal."""
WRITES = "pwrite64", "ftruncate", "unlink"

Event = tuple[str, str, bytes, int]
"""Name of a call, name of its file, data, and offset or size [bytes]."""


def traced_calls(strace: str, folder: Path, sync_s: float) -> list[Event]:
    """Return the writes and fsyncs of a process that commits ``MESSAGES`` transactions, in their order."""
    log = folder.with_name("trace")
    calls = ["-f", "-qq", "-y", "-xx", "-s", "100000", "-e", "trace=pwrite64,write,ftruncate,unlink,fsync,fdatasync"]
    command = [strace, *calls, "-o", log, sys.executable, "-c", WRITER, folder, str(MESSAGES), str(sync_s)]
    subprocess.run(command, check=True, timeout=LONG_S)
    events = list[Event]()
    for line in log.read_text().splitlines():
        assert "unfinished" not in line or "pack.sqlite" not in line, "a call of another thread has split this line"
        if call := CALL.search(line):
            name, descriptor, text, data, *numbers = call.groups()
            path = Path(bytes.fromhex((descriptor or text).replace("\\x", "")).decode())
            if path.is_relative_to(folder):
                content = bytes.fromhex((data or "").replace("\\x", ""))
                events.append((name, path.name, content, int(numbers[-1] or numbers[0] or 0)))
    return events


class Disk:
    """Disk on which a write is certain to survive a power failure only after an fsync: a write to a file after the fsync of the file,
    the removal of a file after the fsync of the folder.
    """

    def __init__(self, folder: str) -> None:
        self._folder, self._synced, self._pending = folder, dict[str, bytes](), list[Event]()
        self.committed = self.synced = 0

    def apply(self, event: Event) -> None:
        """Apply a call of the traced process."""
        name, file, _, _ = event
        if file == "committed":
            self.committed += 1
        elif name in WRITES:
            self._pending.append(event)
        else:
            certain = [each for each in self._pending if self._is_synced(each, file)]
            self._synced = self.files(certain)
            self._pending = [each for each in self._pending if each not in certain]
            self.synced = self.committed

    def _is_synced(self, write: Event, file: str) -> bool:
        """Return True if the fsync of a file, or of the folder, makes a write certain."""
        return file == (self._folder if write[0] == "unlink" else write[1])

    def files(self, writes: Sequence[Event]) -> dict[str, bytes]:
        """Return the files after some of the pending writes."""
        files = dict(self._synced)
        for name, file, data, number in writes:
            if name == "unlink":
                files.pop(file, None)
            else:
                before = files.get(file, b"")
                end = number + len(data)
                files[file] = (
                    before[:number].ljust(number, b"\0") + data + (b"" if name == "ftruncate" else before[end:])
                )
        return files

    def fail(self, dice: random.Random) -> dict[str, bytes]:
        """Return the files after a power failure, with none, all or some of the pending writes."""
        part = dice.choice((0.0, 0.5, 1.0))
        return self.files([each for each in self._pending if dice.random() < part])


@pytest.mark.parametrize("sync_s", [0.0, 1e9], ids=["each transaction synced", "first transaction synced"])
async def test_power_failure_loses_only_the_last_unsynced_transactions(tmp_path: Path, sync_s: float) -> None:
    strace = shutil.which("strace")
    if strace is None:
        pytest.skip("strace is not installed (apt install strace)")
    folder, dice = tmp_path / "store", random.Random(1)
    folder.mkdir()
    disk, losses = Disk(folder.name), 0
    for index, event in enumerate(traced_calls(strace, folder, sync_s)):
        disk.apply(event)
        if event[0] in WRITES and dice.random() < 0.7:
            continue  # a power failure at each write would take long
        after = tmp_path / str(index)
        after.mkdir()
        for name, content in disk.fail(dice).items():
            (after / name).write_bytes(content)
        with capture_logs() as logs:
            async with Database(after / "pack.sqlite") as database:
                numbers = await database.call(message_numbers)
        assert numbers == list(range(len(numbers)))
        at_least = disk.committed if sync_s == 0.0 else min(disk.committed, 1)
        assert max(at_least, disk.synced) <= len(numbers) <= disk.committed + 1
        assert [line["event"] for line in logs] == []
        losses += disk.committed > len(numbers)
        shutil.rmtree(after)
    assert disk.committed == MESSAGES
    assert bool(losses) == (sync_s > 0.0)
