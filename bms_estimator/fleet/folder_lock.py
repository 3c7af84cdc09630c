"""Lock of a folder against other processes of a command."""

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

from bms_estimator.model.errors import TemporaryError


@contextlib.contextmanager
def lock_folder(folder: Path, file: str, conflict: str, mode: int = 0o755) -> Iterator[None]:
    """Lock a folder while the context lasts; create it if it is missing.

    Args:
        folder: The folder.
        file: Name of the lock file.
        conflict: Error text if another process has locked the folder.
        mode: Permissions of a new folder.

    Raises:
        TemporaryError: Another process has locked the folder, or it cannot be written.
    """
    try:
        folder.mkdir(mode=mode, parents=True, exist_ok=True)
        descriptor = os.open(folder / file, os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
    except OSError as error:
        raise TemporaryError(f"--folder {folder}: cannot be written: {error.strerror}") from error
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise TemporaryError(f"--folder {folder}: {conflict}, or choose another folder") from None
        yield
    finally:
        os.close(descriptor)
