"""The board that a pack's service remembers from one start to the next: its serial number and its calibration."""

import json
import re
from collections.abc import Mapping
from pathlib import Path

import structlog

from bms_estimator.process.private_file import UnsafeFileError, read_private, write_private

REMEMBERED = ("serial", "divider", "volts_per_ampere", "bandgap_v")
"""Stored fields of a board's hello."""
NO_BOARD: Mapping[str, str] = dict.fromkeys(REMEMBERED, "")
"""Content of the file once another board is to be accepted."""
_SERIAL = re.compile(r"([0-9a-f]{8})?")
MAX_FILE = 4096
"""Maximum size of the file [bytes]."""

log = structlog.get_logger(__name__)


class KnownBoardFile:
    """``<pack.name>.board.json`` in the state folder, for its owner alone.

    A separate file, because a checkpoint belongs to one meaning of the state and restarts with another cell, while
    the board stays the same; a person may read and delete it.

    Args:
        folder: The state folder.
        pack: The pack's name.
    """

    def __init__(self, folder: Path, pack: str) -> None:
        self.path = folder / f"{pack}.board.json"

    @property
    def how_to_forget(self) -> str:
        """The command, for people, but for the pack's settings file at its end."""
        return f"bms-estimator board --folder {self.path.parent} --accept"

    def load(self) -> Mapping[str, str]:
        """Load the stored board; empty if it is missing or not valid, which is logged."""
        try:
            return _checked(json.loads(read_private(self.path, MAX_FILE)))
        except FileNotFoundError:
            return {}
        except (OSError, UnsafeFileError, ValueError, RecursionError) as error:
            log.warning("the board of the last run is not known", file=str(self.path), reason=str(error))
            return {}

    def is_gone(self) -> bool:
        """Return True if no file has the name.

        Raises:
            OSError: The disk cannot be read.
        """
        try:
            self.path.lstat()
        except FileNotFoundError:
            return True
        return False

    def save(self, board: Mapping[str, str]) -> None:
        """Write atomically. A missing folder is created.

        Raises:
            OSError: The disk cannot be written.
        """
        self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        write_private(self.path, json.dumps(dict(board)).encode() + b"\n")


def _checked(found: object) -> Mapping[str, str]:
    """Check the content of a file.

    Raises:
        ValueError: It is no board.
    """
    if not isinstance(found, dict) or not all(isinstance(found.get(name), str) for name in REMEMBERED):
        raise ValueError("it tells no board")
    if not _SERIAL.fullmatch(found["serial"]):
        raise ValueError(f"serial {found['serial'][:20]!r} is none")
    return {name: found[name] for name in REMEMBERED}
