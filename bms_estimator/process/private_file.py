"""Files that only their owner can read, written atomically: a power failure leaves the old or the new content."""

import os
import stat
from pathlib import Path


class UnsafeFileError(Exception):
    """A private file is not a regular file, or is longer than allowed. The message gives the reason without the path."""


def read_private(path: Path, max_bytes: int) -> bytes:
    """Read a regular file; reject symbolic links and other file types.

    Args:
        path: The file.
        max_bytes: Maximum size [bytes].

    Raises:
        UnsafeFileError: The path is not a regular file, or the file is longer than ``max_bytes``.
        OSError: The file cannot be read.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    with open(descriptor, "rb") as file:  # noqa: PTH123 - a descriptor has no Path
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise UnsafeFileError("not a regular file")
        if status.st_size > max_bytes:
            raise UnsafeFileError(f"longer than {max_bytes} bytes")
        return file.read()


def write_private(path: Path, content: bytes | memoryview) -> None:
    """Write a file atomically, and sync it to disk. A file written by root gets the owner of the folder.

    Args:
        path: The file, in an existing folder. ``<stem>.new`` next to it is written first, and then renamed.
        content: New content of the file.

    Raises:
        OSError: The disk cannot be written. The old file is unchanged.
    """
    new_path = path.with_suffix(".new")
    new_path.unlink(missing_ok=True)  # a power failure may have left it, or it is an unexpected symbolic link
    with open(new_path, "xb", opener=_open_private) as file:
        if os.geteuid() == 0:
            owner = path.parent.stat()
            os.fchown(file.fileno(), owner.st_uid, owner.st_gid)
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    new_path.replace(path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)  # syncs the new name
    finally:
        os.close(folder)


def overwrite_private(path: Path, content: bytes) -> None:
    """Overwrite an existing file in place, and sync it to disk. This needs no free space unless the content grows by a block.

    Raises:
        OSError: The file is missing, a symbolic link, or cannot be written. Its content may be damaged.
    """
    with open(os.open(path, os.O_WRONLY | os.O_NOFOLLOW), "wb") as file:  # noqa: PTH123 - a descriptor has no Path
        file.write(content)
        file.truncate()
        file.flush()
        os.fsync(file.fileno())


def _open_private(path: str, flags: int) -> int:
    return os.open(path, flags, 0o600)
