"""The disk: a folder in memory, with what a power cut leaves of it, and a disk that is full, broken or hung.

The service works on real files of a real folder. Beside it stands what has reached the platter: the bytes of a file with
its fsync, a name with the fsync of its folder. All else is lost or torn by a power cut, as the worst file system may.
"""

import errno
import os
import random
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.world.loop import KilledError


class PowerCutError(BaseException):
    """The machine has no power any more."""


@dataclass
class Arm:
    """What happens at the disk before long."""

    after: int
    """Operations until then."""
    end: type[BaseException]
    """How the process ends there."""


class Disk:
    """One folder.

    Args:
        folder: Where its files are; made anew.
        dice: What a power cut leaves.

    Attributes:
        full: Nothing new can be written.
        broken: Writing fails, the disk says.
        arm: How it ends the process before long; None: it does not.
        operations: So many have changed it.
    """

    def __init__(self, folder: Path, dice: random.Random) -> None:
        self.folder, self._dice = folder, dice
        self._prefix = str(folder) + "/"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        self.full = self.broken = False
        self.arm: Arm | None = None
        self.operations = 0
        self._synced: dict[int, bytes] = {}
        """Inode -> its bytes on the platter."""
        self._names: dict[str, int] = {}
        """Names on the platter."""
        self._pending: list[tuple[str, str, int]] = []
        """Names changed since the folder's fsync: operation, name, inode."""
        self._folders: set[int] = set()

    @contextmanager
    def installed(self) -> Iterator[None]:
        """Have all of this process's calls for files pass here."""
        kept = {name: getattr(os, name) for name in ("open", "fsync", "replace", "rename", "unlink", "remove")}
        try:
            os.open, os.fsync = self._open(kept["open"]), self._fsync(kept["fsync"])
            os.replace = os.rename = self._replace(kept["replace"])
            os.unlink = os.remove = self._unlink(kept["unlink"])
            yield
        finally:
            for name, function in kept.items():
                setattr(os, name, function)

    def cut(self) -> None:
        """The power is cut: leave what is on the platter, and of the rest what chance leaves."""
        content = {path.name: path.read_bytes() for path in self.folder.iterdir() if path.is_file()}
        inodes = {name: (self.folder / name).stat().st_ino for name in content}
        volatile = {inodes[name]: content[name] for name in content}
        names = dict(self._names)
        kept = self._pending[: self._dice.randint(0, len(self._pending))]
        for operation, name, inode in kept:  # a journal is in order
            if operation == "unlink":
                names.pop(name, None)
            else:
                if operation == "replace":
                    names = {other: number for other, number in names.items() if number != inode}
                names[name] = inode
        for path in list(self.folder.iterdir()):
            path.unlink()
        self._synced = {inode: self._left(inode, volatile.get(inode, b"")) for inode in names.values()}
        left, self._names, self._pending = self._synced, {}, []
        self._synced = {}
        for name, inode in names.items():
            path = self.folder / name
            path.write_bytes(left[inode])
            number = path.stat().st_ino
            self._names[name], self._synced[number] = number, left[inode]

    def take_over(self) -> None:
        """All that is there now is on the platter, as if it had been so for long."""
        self._pending = []
        self._names = {path.name: path.stat().st_ino for path in self.folder.iterdir() if path.is_file()}
        self._synced = {inode: (self.folder / name).read_bytes() for name, inode in self._names.items()}

    def _left(self, inode: int, volatile: bytes) -> bytes:
        """What is left of a file."""
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

    def _ours(self, path: Any) -> str | None:
        """Name of a file of this disk."""
        text = os.fspath(path) if not isinstance(path, int) else ""
        return text.removeprefix(self._prefix) if isinstance(text, str) and text.startswith(self._prefix) else None

    def _operation(self) -> None:
        """Something is about to change."""
        self.operations += 1
        if self.arm is not None:
            self.arm.after -= 1
            if self.arm.after < 0:
                end, self.arm = self.arm.end, None
                raise end

    def _refuse(self) -> None:
        if self.full:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if self.broken:
            raise OSError(errno.EIO, os.strerror(errno.EIO))

    def _open(self, real: Callable[..., int]) -> Callable[..., int]:
        def opened(path: Any, flags: int, mode: int = 0o777, *, dir_fd: int | None = None) -> int:
            name = self._ours(path)
            if name is None or dir_fd is not None:
                if path == self.folder or path == str(self.folder):
                    descriptor = real(path, flags, mode)
                    self._folders.add(descriptor)
                    return descriptor
                return real(path, flags, mode, dir_fd=dir_fd)
            writes = flags & (os.O_WRONLY | os.O_RDWR)
            is_new = writes and not os.path.lexists(path)
            if writes and not name.endswith(".lock"):
                self._operation()
                self._refuse()
            descriptor = real(path, flags, mode)
            if is_new:
                self._pending.append(("create", name, os.fstat(descriptor).st_ino))
            return descriptor

        return opened

    def _fsync(self, real: Callable[[int], None]) -> Callable[[int], None]:
        def synced(descriptor: int) -> None:
            if descriptor in self._folders:
                self._folders.discard(descriptor)
                self._operation()
                self._flush_names()
                return
            path = os.readlink(f"/proc/self/fd/{descriptor}")
            if self._ours(path) is None:
                real(descriptor)
                return
            self._operation()
            if self.full or self.broken:  # what was written so far is torn
                os.truncate(path, self._dice.randint(0, os.fstat(descriptor).st_size))
                self._refuse()
            found = os.fstat(descriptor)
            with open(path, "rb") as file:
                self._synced[found.st_ino] = file.read()

        return synced

    def _flush_names(self) -> None:
        for operation, name, inode in self._pending:
            if operation == "unlink":
                self._names.pop(name, None)
            else:
                if operation == "replace":
                    self._names = {other: n for other, n in self._names.items() if n != inode}
                self._names[name] = inode
        self._pending = []

    def _replace(self, real: Callable[[Any, Any], None]) -> Callable[[Any, Any], None]:
        def replaced(source: Any, target: Any, **_: Any) -> None:
            name = self._ours(target)
            if name is None:
                real(source, target)
                return
            self._operation()
            self._refuse()
            inode = os.stat(source).st_ino
            real(source, target)
            self._pending.append(("replace", name, inode))

        return replaced

    def _unlink(self, real: Callable[[Any], None]) -> Callable[..., None]:
        def unlinked(path: Any, *, dir_fd: int | None = None) -> None:
            name = self._ours(path)
            if name is None or dir_fd is not None:
                real(path, dir_fd=dir_fd) if dir_fd is not None else real(path)
                return
            if os.path.lexists(path):
                self._operation()
                self._pending.append(("unlink", name, 0))
            real(path)

        return unlinked


ENDS = (KilledError, PowerCutError)
"""How a process may end at a write."""
