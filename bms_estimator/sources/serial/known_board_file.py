"""File with the serial number and the calibration of a pack's board, which outlives restarts of the service."""

import json
import re
from collections.abc import Mapping
from pathlib import Path

import structlog

from bms_estimator.process.private_file import UnsafeFileError, read_private, write_private

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
