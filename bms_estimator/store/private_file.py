"""A file for its owner alone, written so that after a power cut there is the old one or the new one."""

import os
from pathlib import Path


def write_private(path: Path, content: bytes | memoryview) -> None:
    """Write a whole file atomically, and wait until the disk has it.

    Args:
        path: The file, in a folder that is there; beside it ``<stem>.new`` is written first.
        content: All of it.

    Raises:
        OSError: The disk does not take it. The old file is as it was.
    """
    new = path.with_suffix(".new")
    new.unlink(missing_ok=True)  # what a power cut has left, or somebody has planted
    with open(new, "xb", opener=_private) as file:
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
