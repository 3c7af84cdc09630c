"""Which serial ports there are, which of them is the board's, how one is opened, and who holds one."""

import errno
import os
import termios
from pathlib import Path

import serial
from serial.tools import list_ports

BY_ID = Path("/dev/serial/by-id")


class NoPortError(Exception):
    """The board's port cannot be told or opened; the message is the port and why. It may come yet."""


def stable_names() -> list[Path]:
    """Names under /dev/serial/by-id; none where no USB serial port is there."""
    try:
        return sorted(BY_ID.iterdir())
    except OSError:  # the folder comes with the first port and goes with the last
        return []


def board_ports() -> list[str]:
    """Ports that may be a board: the stable names, else USB serial devices."""
    names = [str(path) for path in stable_names()]
    return names or sorted(port.device for port in list_ports.comports() if port.vid is not None)


def resolve_port(port: str) -> str:
    """The device path of ``port``, which may be ``auto``.

    Raises:
        NoPortError: No board is there, or with ``auto`` more than one.
    """
    if port != "auto":
        if not Path(port).exists():
            raise NoPortError(f"{port}: it does not exist")
        return port
    found = board_ports()
    if not found:
        raise NoPortError("auto: no USB serial port is there")
    if len(found) > 1:
        raise NoPortError(f"auto: {len(found)} serial ports are there; choose one: {', '.join(found)}")
    return found[0]


def open_port(path: str, baud: int, timeout_s: float = 0.0) -> serial.Serial:
    """Open a port for ourselves alone.

    Args:
        path: Of the device.
        baud: [1/s].
        timeout_s: How long a read waits [s].

    Raises:
        NoPortError: It cannot be opened; the message says who holds it if that is why and can be seen.
    """
    try:
        return serial.Serial(path, baud, timeout=timeout_s, exclusive=True)
    except (OSError, termios.error, ValueError, OverflowError) as error:  # a port may die while it is opened
        if isinstance(error, OSError) and error.errno in (errno.EBUSY, errno.EAGAIN):
            raise NoPortError(f"{path}: held by {holder(path) or 'another process'}") from None
        raise NoPortError(f"{path}: cannot be opened: {error}") from None


def holder(port: str) -> str | None:
    """Who has ``port`` open, as ``name (pid n)``; None when nobody else, or when it cannot be seen."""
    device = os.path.realpath(port)
    for process in Path("/proc").glob("[0-9]*"):
        if process.name != str(os.getpid()) and _has_open(process, device):
            try:
                name = (process / "comm").read_text(encoding="utf-8", errors="replace").strip()
            except OSError:
                continue
            return f"{name} (pid {process.name})"
    return None


def _has_open(process: Path, device: str) -> bool:
    try:
        return any(str(entry.readlink()) == device for entry in (process / "fd").iterdir())
    except OSError:  # it has ended, or belongs to someone else
        return False
