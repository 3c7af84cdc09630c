"""A pack is served by one process at a time."""

import contextlib
import hashlib
import os
import socket
import struct
from collections.abc import Iterator
from pathlib import Path

import structlog

from bms_estimator.model.errors import UserError

ROOT = 0
_CREDENTIALS = struct.Struct("3i")
"""``struct ucred``: process, user, group."""

log = structlog.get_logger(__name__)


@contextlib.contextmanager
def alone(folder: Path, pack: str) -> Iterator[None]:
    """Serve a pack alone: two services would overwrite each other's checkpoint and availability.

    Held is an abstract socket named after folder and pack. It is gone with the process however that ends, is no file that
    could be planted, deleted or left over, and does not depend on a disk. Whoever is on the machine could take the name
    first; so a holder counts only where it may write the folder anyway. A container with a network of its own has
    names of its own.

    Args:
        folder: Where the pack's state is kept.
        pack: Its name.

    Raises:
        UserError: Another process serves it.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as held:
        name = _name(folder, pack)
        try:
            held.bind(name)
            held.listen(1)
        except OSError as error:
            process, user = _holder(name)
            if user in _writers(folder):
                raise UserError(f"{pack}: this pack is served already, by process {process}") from None
            log.warning("cannot make sure that this pack is served once", reason=error.strerror, user=user)
        yield


def _name(folder: Path, pack: str) -> str:
    """Of a length that a socket's may have."""
    place = os.path.realpath(folder)
    return f"\0bms-estimator-{hashlib.sha256(os.fsencode(f'{place}/{pack}')).hexdigest()[:32]}"


def _holder(name: str) -> tuple[int, int]:
    """Process and user that hold a name, as the system has it; -1 where it does not say."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as asking:
        asking.setblocking(False)
        try:
            asking.connect(name)
            told = asking.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
        except OSError:
            return -1, -1
    process, user, _ = _CREDENTIALS.unpack(told)
    return process, user


def _writers(folder: Path) -> set[int]:
    """Users whose processes may serve the pack."""
    users = {ROOT, os.geteuid()}
    with contextlib.suppress(OSError):
        users.add(folder.stat().st_uid)
    return users
