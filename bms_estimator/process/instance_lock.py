"""A pack is served by one process at a time."""

import contextlib
import errno
import hashlib
import os
import socket
import struct
import time
from collections.abc import Iterator
from pathlib import Path

import structlog

from bms_estimator.model.errors import UserError

ROOT = 0
ATTEMPTS, PAUSE_S = 20, 0.01
"""Number of attempts to take a name that is held but not listening, and the delay between them [s]."""
_CREDENTIALS = struct.Struct("3i")
"""``struct ucred``: process, user, group."""

log = structlog.get_logger(__name__)


@contextlib.contextmanager
def instance_lock(folder: Path, pack: str) -> Iterator[None]:
    """Serve a pack alone: two services would overwrite each other's checkpoint and availability.

    Held is an abstract socket named after folder and pack. It disappears with the process, is not a file that could
    be deleted or left over, and does not depend on a disk. Whoever is on the machine could take the name
    first; so a holder that may not write the folder anyway does not count. An unknown holder counts as a service,
    because two services are worse than none. A container with a network of its own has names of its own.

    Args:
        folder: Folder of the pack's state.
        pack: Name of the pack.

    Raises:
        UserError: Another process serves it.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as held:
        try:
            _hold(held, folder, pack)
        except OSError as error:
            log.warning("cannot make sure that this pack is served once", reason=error.strerror)
        yield


def _hold(held: socket.socket, folder: Path, pack: str) -> None:
    """Take the name, unless a service has it.

    Raises:
        UserError: One has it.
        OSError: The system refuses such a name.
    """
    name, told = _name(folder, pack), None
    for _ in range(ATTEMPTS):
        try:
            held.bind(name)
            held.listen(1)
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
        else:
            return
        try:
            process, user = _holder(name)
        except ConnectionRefusedError:  # it is about to listen, or has just ended
            time.sleep(PAUSE_S)
            continue
        except BlockingIOError:
            break
        if user not in _writers(folder):
            log.warning("a stranger has this pack's name: cannot make sure that it is served once", user=user)
            return
        told = process
        break
    raise UserError(f"{pack}: this pack is served already, by {f'process {told}' if told else 'another process'}")


def _name(folder: Path, pack: str) -> str:
    """Return a name within the length limit of a socket's."""
    place = os.path.realpath(folder)
    return f"\0bms-estimator-{hashlib.sha256(os.fsencode(f'{place}/{pack}')).hexdigest()[:32]}"


def _holder(name: str) -> tuple[int, int]:
    """Return process and user that hold a name.

    Raises:
        ConnectionRefusedError: No process holds it, or the holder does not listen.
        BlockingIOError: The listen queue of the holder is full. It accepts no connection, and the system reports the holder only to
            as many clients as the queue holds, even after they have gone.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as asking:
        asking.setblocking(False)
        asking.connect(name)
        told = asking.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    process, user, _ = _CREDENTIALS.unpack(told)
    return process, user


def _writers(folder: Path) -> set[int]:
    """Users whose processes may serve the pack."""
    users = {ROOT, os.geteuid()}
    with contextlib.suppress(OSError):
        users.add(folder.stat().st_uid)
    return users
