"""A pack is served by one process at a time."""

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

import structlog

from bms_estimator.model.errors import UserError

log = structlog.get_logger(__name__)


@contextlib.contextmanager
def alone(path: Path) -> Iterator[None]:
    """Serve a pack alone: two services would overwrite each other's checkpoint and availability.

    Args:
        path: Lock file, made where it is not there; the system frees it however the process ends.

    Raises:
        UserError: Another process holds it.
    """
    with contextlib.ExitStack() as held:
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600)
            held.callback(os.close, descriptor)
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            os.ftruncate(descriptor, 0)
            os.write(descriptor, f"{os.getpid()}\n".encode())
        except BlockingIOError:
            holder = path.read_text(encoding="ascii").strip() or "?"
            raise UserError(f"{path}: this pack is served already, by process {holder}") from None
        except OSError as error:  # nor will the checkpoint be written, which health says
            log.warning("cannot make sure that this pack is served once", file=str(path), reason=error.strerror)
        yield
