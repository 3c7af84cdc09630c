"""Disk that loses unsynced data at a power cut, and that can be full, broken or hung.

The service uses real files in a real folder. In addition, this module stores the synced data: the bytes of a file at
its last fsync, and the names in the folder at the folder's last fsync. A power cut loses or truncates all other data,
as the least reliable file systems do.
"""

import errno
import math
import os
import random
import shutil
import sqlite3
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

MAX_SYNC_DELAY_S = 31.0
"""Maximum time until a committed transaction is synced [s], by a later one of ``store.database`` or by the operating system."""


class PowerCutError(BaseException):
    """Power cut of the machine."""


@dataclass
class ArmedFault:
    """Fault that ends the process at one of its next operations on the disk."""

    operations_left: int
    """Number of operations until it occurs."""
    error: type[BaseException]
    """Exception that ends the process."""


class Disk:
    """Folder on a simulated disk.

    Args:
        folder: Path of the folder, which is emptied.
        dice: Random generator that selects the unsynced data that survive a power cut.

    Attributes:
        full: True if writes fail with ENOSPC.
        broken: True if writes fail with EIO.
        hung: True if calls of the disk do not return.
        armed_fault: Fault that will end the process at one of the next operations; None: no fault.
        operations: Number of operations that changed the disk.
    """

    def __init__(self, folder: Path, dice: random.Random) -> None:
        self.folder, self._dice = folder, dice
        self._prefix = str(folder) + "/"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        self.full = self.broken = self.hung = False
        self.armed_fault: ArmedFault | None = None
        self.operations = 0
        self._synced: dict[int, bytes] = {}
        """Synced bytes by inode."""
        self._names: dict[str, int] = {}
        """Inode by name of file, at the last fsync of the folder."""
        self._pending: list[tuple[str, str, int]] = []
        """Name changes since the folder's last fsync: operation, name, inode."""
        self._folders: set[int] = set()
        """Descriptors of the folder, which the service opens to sync its names."""
        self.connections: list[sqlite3.Connection] = []
        """Database connections of the present process."""
        self._log_sizes: dict[str, deque[tuple[float, int]]] = {}
        """Time [s] and size [bytes] of each write-ahead log after each transaction, by name of file."""

    @property
    def is_faulty(self) -> bool:
        """True if the disk is full, broken or hung."""
        return self.full or self.broken or self.hung

    @contextmanager
    def installed(self) -> Iterator[None]:
        """Replace the file functions of ``os`` in this process."""
        originals = {
            name: getattr(os, name) for name in ("open", "fsync", "fdatasync", "replace", "rename", "unlink", "remove")
        }
        try:
            os.open, os.fsync = self._open(originals["open"]), self._fsync(originals["fsync"])
            os.fdatasync = self._fsync(originals["fdatasync"])
            os.replace = os.rename = self._replace(originals["replace"])
            os.unlink = os.remove = self._unlink(originals["unlink"])
            yield
        finally:
            for name, function in originals.items():
                setattr(os, name, function)

    def end_process(self) -> None:
        """Drop the database connections of an ended process without closing them."""
        # Closing a connection moves the write-ahead log to the database, which a kill does not. Therefore the files are
        # restored, except the index (-shm), which SQLite builds from the log.
        contents = {path: path.read_bytes() for path in self._databases()}
        for connection in self.connections:
            connection.close()
        self.connections.clear()
        for path in self._databases():
            path.unlink()
        for path, content in contents.items():
            if not path.name.endswith("-shm"):
                path.write_bytes(content)

    def run_transaction(self, call: Callable[[], Any], now_s: float) -> Any:
        """Run a call that uses a database.

        Raises:
            OperationalError: The disk is full or broken.
        """
        if self.full or self.broken:
            raise sqlite3.OperationalError("database or disk is full" if self.full else "disk I/O error")
        value = call()
        self._record_log_sizes(now_s)
        return value

    def _record_log_sizes(self, now_s: float) -> None:
        """Record the sizes of the write-ahead logs, because a log is synced up to its size ``MAX_SYNC_DELAY_S`` ago."""
        for path in self._databases():
            if path.name.endswith("-wal"):
                sizes = self._log_sizes.setdefault(path.name, deque())
                size = path.stat().st_size
                if sizes and sizes[-1][1] > size:
                    sizes.clear()  # SQLite has begun a new log
                sizes.append((now_s, size))

    def _databases(self) -> list[Path]:
        return [self.folder / name for name in sorted(os.listdir(self.folder)) if ".sqlite" in name]  # noqa: PTH208 - quicker

    def cut_power(self, now_s: float) -> None:
        """Cut the power: synced data and a random part of the other data survive."""
        self.armed_fault = None  # no process runs that could reach it
        databases = {path: path.read_bytes() for path in self._databases()}
        self._cut_files()  # deletes the databases, too
        for path, content in databases.items():
            if path.name.endswith("-wal"):
                sizes = self._log_sizes.get(path.name, deque())
                synced = max((size for at_s, size in sizes if at_s < now_s - MAX_SYNC_DELAY_S), default=0)
                surviving = self._dice.randint(min(synced, len(content)), len(content))
                path.write_bytes(content[:surviving])
                self._log_sizes[path.name] = deque([(-math.inf, surviving)])  # all surviving bytes are synced
            else:
                path.write_bytes(content)

    def _cut_files(self) -> None:
        """Replace the files by those that survive a power cut."""
        content = {path.name: path.read_bytes() for path in sorted(self.folder.iterdir()) if path.is_file()}
        inodes = {name: (self.folder / name).stat().st_ino for name in content}
        volatile = {inodes[name]: content[name] for name in content}
        surviving_changes = self._pending[: self._dice.randint(0, len(self._pending))]
        names = _replay(surviving_changes, self._names)  # as the journal of the file system does
        for path in list(self.folder.iterdir()):
            path.unlink()
        surviving = {inode: self._surviving_bytes(inode, volatile.get(inode, b"")) for inode in names.values()}
        self._synced, self._names, self._pending = {}, {}, []
        for name, inode in names.items():
            path = self.folder / name
            path.write_bytes(surviving[inode])
            number = path.stat().st_ino
            self._names[name], self._synced[number] = number, surviving[inode]

    def connect(self, *arguments: Any, **named: Any) -> sqlite3.Connection:
        """Replacement of ``sqlite3.connect``."""
        self.connections.append(sqlite3.connect(*arguments, **named))
        return self.connections[-1]

    def _surviving_bytes(self, inode: int, volatile: bytes) -> bytes:
        """Return the bytes of a file after a power cut. Unsynced files survive whole, empty, truncated or filled with zeros."""
        synced = self._synced.get(inode)
        if synced is not None and (not volatile or volatile == synced):
            return synced
        match self._dice.randrange(4):
            case 0:
                return volatile
            case 1:
                return b""
            case 2:
                return volatile[: self._dice.randint(0, len(volatile))]
            case _:
                return bytes(len(volatile))

    def _name_on_disk(self, path: Any) -> str | None:
        """Return the name of a file on this disk; None for files elsewhere and for databases, which need other functions."""
        text = os.fspath(path) if not isinstance(path, int) else ""
        return (
            text.removeprefix(self._prefix)
            if isinstance(text, str) and text.startswith(self._prefix) and ".sqlite" not in text
            else None
        )

    def _count_operation(self) -> None:
        """Count an operation, and raise an armed fault that is due."""
        self.operations += 1
        if self.armed_fault is not None:
            self.armed_fault.operations_left -= 1
            if self.armed_fault.operations_left < 0:
                error, self.armed_fault = self.armed_fault.error, None
                raise error

    def _raise_if_faulty(self) -> None:
        if self.full:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if self.broken:
            raise OSError(errno.EIO, os.strerror(errno.EIO))

    def _open(self, real: Callable[..., int]) -> Callable[..., int]:
        def open_file(path: Any, flags: int, mode: int = 0o777, *, dir_fd: int | None = None) -> int:
            name = self._name_on_disk(path)
            if name is None or dir_fd is not None:
                if path == self.folder or path == str(self.folder):
                    descriptor = real(path, flags, mode)
                    self._folders.add(descriptor)
                    return descriptor
                return real(path, flags, mode, dir_fd=dir_fd)
            writes = flags & (os.O_WRONLY | os.O_RDWR)
            is_new = writes and not os.path.lexists(path)
            if writes and not name.endswith(".lock"):
                self._count_operation()
                self._raise_if_faulty()
            descriptor = real(path, flags, mode)
            if is_new:
                self._pending.append(("create", name, os.fstat(descriptor).st_ino))
            return descriptor

        return open_file

    def _fsync(self, real: Callable[[int], None]) -> Callable[[int], None]:
        def sync_file(descriptor: int) -> None:
            if descriptor in self._folders:
                self._folders.discard(descriptor)
                self._count_operation()
                self._names, self._pending = _replay(self._pending, self._names), []
                return
            path = os.readlink(f"/proc/self/fd/{descriptor}")  # noqa: PTH115 - no ordinary link
            if self._name_on_disk(path) is None:
                real(descriptor)
                return
            self._count_operation()
            if self.full or self.broken:  # only a part of the written data has reached the disk
                os.truncate(path, self._dice.randint(0, os.fstat(descriptor).st_size))
                self._raise_if_faulty()
            self._synced[os.fstat(descriptor).st_ino] = Path(path).read_bytes()

        return sync_file

    def _replace(self, real: Callable[[Any, Any], None]) -> Callable[[Any, Any], None]:
        def replace_file(source: Any, target: Any, **_: Any) -> None:
            name = self._name_on_disk(target)
            if name is None:
                real(source, target)
                return
            self._count_operation()
            self._raise_if_faulty()
            inode = Path(source).stat().st_ino
            real(source, target)
            self._pending.append(("replace", name, inode))

        return replace_file

    def _unlink(self, real: Callable[[Any], None]) -> Callable[..., None]:
        def unlink_file(path: Any, *, dir_fd: int | None = None) -> None:
            name = self._name_on_disk(path)
            if name is None or dir_fd is not None:
                real(path, dir_fd=dir_fd)
                return
            if os.path.lexists(path):
                self._count_operation()
                self._pending.append(("unlink", name, 0))
            real(path)

        return unlink_file


def _replay(changes: list[tuple[str, str, int]], names: dict[str, int]) -> dict[str, int]:
    """Return the names of a folder, with their inodes, after changes in their order."""
    names = dict(names)
    for operation, name, inode in changes:
        if operation == "unlink":
            names.pop(name, None)
            continue
        if operation == "replace":  # the inode loses its former name
            names = {other: number for other, number in names.items() if number != inode}
        names[name] = inode
    return names
