"""Files for their owner alone, each written so that after a power cut there is the old one or the new one."""

import os
import stat
from pathlib import Path


class UnsafeFileError(Exception):
    """The file in place of a private file belongs to another user."""


def read_private(path: Path, longest: int) -> bytes:
    """Read a whole regular file; refuse links and other file types.

    Args:
        path: The file.
        longest: Maximum size [bytes].

    Raises:
        UnsafeFileError: It is too long or no file.
        OSError: It cannot be read.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    with open(descriptor, "rb") as file:  # noqa: PTH123 - a descriptor has no Path
        found = os.fstat(descriptor)
        if not stat.S_ISREG(found.st_mode) or found.st_size > longest:
            raise UnsafeFileError("no file, or too long")
        return file.read()


def write_private(path: Path, content: bytes | memoryview) -> None:
    """Write a whole file atomically, and wait until the disk has it. Root writes for the owner of the folder.

    Args:
        path: The file, in a folder that is there; beside it ``<stem>.new`` is written first.
        content: All of it.

    Raises:
        OSError: The disk cannot be written. The old file is as it was.
    """
    new = path.with_suffix(".new")
    new.unlink(missing_ok=True)  # left by a power cut, or an unexpected symlink
    with open(new, "xb", opener=_private) as file:
        if os.geteuid() == 0:
            folder_is = path.parent.stat()
            os.fchown(file.fileno(), folder_is.st_uid, folder_is.st_gid)
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    new.replace(path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)  # its name, too
    finally:
        os.close(folder)


def _private(path: str, flags: int) -> int:
    return os.open(path, flags, 0o600)
