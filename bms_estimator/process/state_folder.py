"""State folder of a service, and the lock that lets only one process serve a pack at a time.

Its files can be read only by their owner, and are written atomically: a power failure leaves the old or the new content.
"""

import contextlib
import errno
import hashlib
import os
import socket
import stat
import struct
import time
from collections.abc import Iterator
from pathlib import Path

import structlog

from bms_estimator.model.errors import TemporaryError
from bms_estimator.settings.pack import Settings


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


ROOT_USER = 0
"""User id of root."""
ATTEMPTS = 20
"""Number of attempts to bind a name whose holder does not listen."""
ATTEMPT_DELAY_S = 0.01
"""Delay between two attempts to bind a name [s]."""
SOCKETS = Path("/proc/net/unix")
"""List of all Unix sockets. The names of abstract sockets begin with @."""
_CREDENTIALS = struct.Struct("3i")
"""Layout of ``struct ucred``: process, user, group."""

log = structlog.get_logger(__name__)


@contextlib.contextmanager
def instance_lock(folder: Path, pack: str) -> Iterator[None]:
    """Hold the lock of a pack, because two services would overwrite each other's checkpoint and availability.

    The lock is an abstract socket named after folder and pack. It disappears with the process, cannot be deleted or left
    over like a file, and does not depend on a disk. Any user of the machine could bind the name first. A holder without
    write permission for the folder is therefore ignored. An unknown holder counts as a service, because two services do
    more harm than no service. A container with its own network namespace has its own names.

    Args:
        folder: Folder of the pack's state.
        pack: Name of the pack.

    Raises:
        TemporaryError: Another process serves the pack.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as lock:
        try:
            _bind(lock, folder, pack)
        except OSError as error:
            log.warning("cannot ensure that only one process serves this pack", reason=error.strerror)
        yield


def is_locked(folder: Path, pack: str) -> bool:
    """Return True if a process holds the lock of a pack.

    The list of sockets is read instead of connecting, because a connection would stay in the queue of the holder.
    """
    name = _socket_name(folder, pack).replace("\0", "@")
    with contextlib.suppress(OSError):
        return any(line.endswith(f" {name}") for line in SOCKETS.read_text(encoding="utf-8").splitlines())
    return False


def lock_holder(folder: Path, pack: str) -> int | None:
    """Return the process that holds the lock of a pack; None if no process holds it, or if its id is unknown.

    A process in another PID namespace, such as that of a container, has no id here. Each call leaves a connection in the short
    queue of the holder, so that later calls may not learn the id.
    """
    with contextlib.suppress(OSError):
        return _find_holder(_socket_name(folder, pack))[0] or None  # 0: other PID namespace
    return None


def _bind(lock: socket.socket, folder: Path, pack: str) -> None:
    """Bind the name of the lock, unless a service has it.

    Raises:
        TemporaryError: A service has the name.
        OSError: The system rejects the name.
    """
    name, process_id = _socket_name(folder, pack), None
    for _ in range(ATTEMPTS):
        try:
            lock.bind(name)
            lock.listen(1)
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
        else:
            return
        try:
            process_id, user = _find_holder(name)
        except ConnectionRefusedError:  # the holder does not listen yet, or has just ended
            time.sleep(ATTEMPT_DELAY_S)
            continue
        except BlockingIOError:
            break
        if user not in _find_writers(folder):
            log.warning("another user holds this pack's lock: cannot ensure that only one process serves it", user=user)
            return
        break
    raise TemporaryError(
        f"{pack}: this pack is served already, by {f'process {process_id}' if process_id else 'another process'}; "
        "stop it first"
    )


def _socket_name(folder: Path, pack: str) -> str:
    """Return the name of the lock, a hash within the length limit of socket names."""
    return f"\0bms-estimator-{hashlib.sha256(os.fsencode(f'{os.path.realpath(folder)}/{pack}')).hexdigest()[:32]}"


def _find_holder(name: str) -> tuple[int, int]:
    """Return process and user that hold a name.

    Raises:
        ConnectionRefusedError: No process holds the name, or the holder does not listen.
        BlockingIOError: The listen queue of the holder is full. The holder never accepts a connection, so that clients
            stay in the queue even after they have ended.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
        client.setblocking(False)
        client.connect(name)
        process, user, _ = _CREDENTIALS.unpack(
            client.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
        )
    return process, user


def _find_writers(folder: Path) -> set[int]:
    """Return the users whose processes may serve the pack."""
    users = {ROOT_USER, os.geteuid()}
    with contextlib.suppress(OSError):
        users.add(folder.stat().st_uid)
    return users


def state_folder_path(settings: Settings) -> Path:
    """Return the path of the folder of checkpoints, in which ``~`` is not expanded.

    The folder is ``state.folder`` of the settings, otherwise systemd's StateDirectory, otherwise the user's XDG state folder.
    """
    systemd = os.environ.get("STATE_DIRECTORY", "").split(":")[0]
    home = os.environ.get("XDG_STATE_HOME") or "~/.local/state"
    return settings.state.folder or Path(systemd or f"{home}/bms-estimator")


def state_folder(settings: Settings) -> Path:
    """Return the folder of ``state_folder_path``, and create it.

    If a folder that the settings do not name cannot be created, a warning is logged, and a later save reports the error.

    Raises:
        TemporaryError: The folder of the settings cannot be created.
    """
    folder = state_folder_path(settings)
    try:
        folder = folder.expanduser()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except (OSError, RuntimeError) as error:  # RuntimeError: the user has no home folder
        reason = error.strerror if isinstance(error, OSError) else str(error)
        if settings.state.folder:
            raise TemporaryError(f"state.folder = {folder}: {reason}") from error
        log.warning("the state will be lost at a restart", folder=str(folder), reason=reason)
    return folder
