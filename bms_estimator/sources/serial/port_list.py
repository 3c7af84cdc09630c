"""Serial ports: list, choice of the board's port, opening, and search for the process that uses one."""

import errno
import json
import os
import re
import termios
from collections.abc import Collection, Mapping
from pathlib import Path

import serial
import structlog
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from bms_estimator.process.state_folder import UnsafeFileError, read_private, write_private

STORED_FIELDS = ("serial", "divider", "volts_per_ampere", "ratiometric", "current_zero", "bandgap_v")
"""Fields of a board's hello that are stored: the serial number and all of the calibration."""
NO_BOARD: Mapping[str, str] = dict.fromkeys(STORED_FIELDS, "")
"""Content of the file that makes the service accept any board as the pack's."""
_SERIAL_PATTERN = re.compile(r"([0-9a-f]{8})?")
MAX_FILE_BYTES = 4096
"""Maximum size of the file [bytes]."""

log = structlog.get_logger(__name__)


class KnownBoardFile:
    """File ``<pack.name>.board.json`` in the state folder, readable by its owner only.

    The file is separate from the checkpoint, because a checkpoint is discarded when the cell changes, but the board is not.
    Users may read and delete the file.

    Args:
        folder: The state folder.
        pack: The pack's name.
    """

    def __init__(self, folder: Path, pack: str) -> None:
        self.path = folder / f"{pack}.board.json"

    @property
    def accept_command(self) -> str:
        """Text of the command that accepts another board. The caller appends the path of the settings file."""
        return f"bms-estimator board --folder {self.path.parent} --accept"

    def load(self) -> Mapping[str, str]:
        """Load the stored board; empty if the file is missing or not valid. An invalid file is logged."""
        try:
            return _validate(json.loads(read_private(self.path, MAX_FILE_BYTES)))
        except FileNotFoundError:
            return {}
        except (OSError, UnsafeFileError, ValueError, RecursionError) as error:
            log.warning("the stored board cannot be read", file=str(self.path), reason=str(error))
            return {}

    def is_missing(self) -> bool:
        """Return True if the file does not exist.

        Raises:
            OSError: The disk cannot be read.
        """
        try:
            self.path.lstat()
        except FileNotFoundError:
            return True
        return False

    def save(self, board: Mapping[str, str]) -> None:
        """Write the file atomically; create the folder if it is missing.

        Raises:
            OSError: The disk cannot be written.
        """
        self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        write_private(self.path, json.dumps(dict(board)).encode() + b"\n")


def _validate(content: object) -> Mapping[str, str]:
    """Return the stored fields of a file's content.

    Raises:
        ValueError: The content is not a board.
    """
    if not isinstance(content, dict) or "serial" not in content:
        raise ValueError("no board in it")
    board = {name: content.get(name, "") for name in STORED_FIELDS}  # a former version stored fewer fields
    if not all(isinstance(value, str) for value in board.values()):
        raise ValueError("no board in it")
    if not _SERIAL_PATTERN.fullmatch(board["serial"]):
        raise ValueError(f"serial {board['serial'][:20]!r} is not valid")
    return board


BY_ID = Path("/dev/serial/by-id")
"""Folder of udev's stable names of USB serial ports."""
WRITE_TIMEOUT_S = 1.0
"""Timeout of a write [s]. The longest query takes a tenth of this time on a serial line."""
ANY_PRODUCT = range(0x10000)
BRIDGE_CHIPS: Mapping[int, Collection[int]] = {
    0x0403: (0x6001, 0x6010, 0x6011, 0x6014, 0x6015),  # FTDI FT232, FT2232, FT4232, FT232H, FT231X
    0x067B: (0x2303, 0x23A3, 0x23C3, 0x23D3),  # Prolific PL2303
    0x10C4: (0xEA60, 0xEA70),  # Silicon Labs CP210x
    0x1A86: (0x5523, 0x7522, 0x7523, 0x55D3, 0x55D4),  # WCH CH341, CH340, CH343, CH9102
    0x2341: ANY_PRODUCT,  # Arduino, its ATmega16U2
    0x2A03: ANY_PRODUCT,  # Arduino, second vendor id
}
"""USB product ids of boards that ``auto`` selects, by vendor id."""
RADIO_STICK = re.compile(
    r"zig-?bee|z-?wave|openthread|conbee|raspbee|sky ?connect|nabu casa|sonoff|itead|zbt-|zwa-|hubz|slzb|slae|zooz"
    r"|aeotec|cc(1352|26\d\d)|efr32",
    re.IGNORECASE,
)
"""USB descriptions of radio sticks with the same chips as boards."""


class NoPortError(Exception):
    """The board's port cannot be found or opened. The message has the port and the reason; a retry may succeed."""


class PortBusyError(NoPortError):
    """Another process has the port at ``path`` open.

    The error text names the process that uses the port. The search through all processes takes milliseconds, so that it
    runs only when the text is needed.
    """

    def __init__(self, path: str) -> None:
        super().__init__(path)
        self.path = path

    def __str__(self) -> str:
        return f"{self.path}: in use by {holder(self.path) or 'another process or another pack of this process'}"


def stable_names() -> list[Path]:
    """Return the names in /dev/serial/by-id; empty without a USB serial port."""
    try:
        return sorted(BY_ID.iterdir())
    except OSError:  # the folder exists only while a port is connected
        return []


def resolve_port(port: str) -> str:
    """Return the device path of ``port``, which may be ``auto``.

    Raises:
        NoPortError: The port does not exist or is a file or folder, or ``auto`` finds no board or more than one.
    """
    if port != "auto":
        if not os.path.exists(port):  # noqa: PTH110 - Path.exists raises if the name is too long
            raise NoPortError(f"{port}: it does not exist")
        if not Path(port).is_char_device():
            raise NoPortError(f"{port}: it is not a serial port")
        return port
    candidates = board_ports()
    if len(candidates) == 1:
        return candidates[0]
    if candidates:
        raise NoPortError(f"auto: {len(candidates)} serial ports are connected; choose one: {', '.join(candidates)}")
    if usb_ports := [port for port in list_ports.comports() if port.vid is not None]:
        others = ", ".join(f"{port.device} ({port.product or port.description})" for port in usb_ports)
        raise NoPortError(
            f"auto: no port of a known board is connected; if one of these is the board, set sensor.port to it: {others}"
        )
    raise NoPortError("auto: no USB serial port is connected")


def named_ports() -> dict[str, ListPortInfo]:
    """Return all serial ports by their stable names, or by their device paths if they have none."""
    names = {os.path.realpath(path): str(path) for path in stable_names()}
    ports = {port.device: port for port in list_ports.comports()}
    return {names.get(os.path.realpath(device), device): port for device, port in ports.items()}


def board_ports() -> list[str]:
    """Return the ports that may belong to a board, by their stable names if they have one."""
    return sorted(name for name, port in named_ports().items() if may_be_board(port))


def may_be_board(port: ListPortInfo) -> bool:
    """Return True if a port has a USB chip that is common on boards, and is not described as a radio stick."""
    description = " ".join(word for word in (port.manufacturer, port.product, port.description) if word)
    return port.pid in BRIDGE_CHIPS.get(port.vid or 0, ()) and not RADIO_STICK.search(description)


def open_port(path: str, baud: int, timeout_s: float = 0.0) -> serial.Serial:
    """Open a port exclusively.

    Args:
        path: Path of the device.
        baud: Baud rate [1/s].
        timeout_s: Timeout of a read [s].

    Raises:
        PortBusyError: Another process has the port open.
        NoPortError: The port cannot be opened.
    """
    try:
        return serial.Serial(path, baud, timeout=timeout_s, write_timeout=WRITE_TIMEOUT_S, exclusive=True)
    except (OSError, termios.error, ValueError, OverflowError) as error:  # a port may die while it is opened
        if isinstance(error, OSError) and error.errno in (errno.EBUSY, errno.EAGAIN):
            raise PortBusyError(path) from None
        reason = os.strerror(error.errno) if isinstance(error, OSError) and error.errno else error
        raise NoPortError(f"{path}: cannot be opened: {reason}") from None


def holder(port: str) -> str | None:
    """Return the other process that has ``port`` open, as ``name (pid n)``; None if no process is found, or it belongs to another user."""
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
    except OSError:  # the process has ended, or belongs to another user
        return False
