"""Which serial ports there are, which of them is the board's, and who holds one."""

import os
from pathlib import Path

from serial.tools import list_ports

BY_ID = Path("/dev/serial/by-id")


class NoPortError(Exception):
    """The board's port cannot be told; the message says what was found. It may come yet."""


def board_ports() -> list[str]:
    """Ports that may be a board: the stable names under /dev/serial/by-id, else USB serial devices."""
    if BY_ID.is_dir():
        return sorted(str(path) for path in BY_ID.iterdir())
    return sorted(port.device for port in list_ports.comports() if port.vid is not None)


def resolve_port(port: str) -> str:
    """The device path of ``port``, which may be ``auto``.

    Raises:
        NoPortError: No board is there, or with ``auto`` more than one.
    """
    if port != "auto":
        if not Path(port).exists():
            raise NoPortError(f"waiting for {port}: it does not exist")
        return port
    found = board_ports()
    if not found:
        raise NoPortError("waiting for a board: no USB serial port is there")
    if len(found) > 1:
        raise NoPortError(f"{len(found)} serial ports are there; set sensor.port to one of {', '.join(found)}")
    return found[0]


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
