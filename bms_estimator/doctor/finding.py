"""Pack that is examined, and findings of the checks."""

import os
import shlex
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from bms_estimator.doctor.systemd_unit import SystemdUnit
from bms_estimator.installation.machine import root_command
from bms_estimator.model.pack_model import PackModel
from bms_estimator.process.state_folder import is_locked, state_folder_path
from bms_estimator.settings.pack import Settings

STATE_ROOT = Path("/var/lib")
"""Folder of the state folders of systemd units."""
CACHE_ROOT = Path("/var/cache")
"""Folder of the cache folders of systemd units."""
ROOT_USER = 0
"""User id of root."""


@dataclass(frozen=True)
class ExaminedPack:
    """Pack that is examined, and its service."""

    path: Path
    """Settings file."""
    settings: Settings
    model: PackModel
    """Model of the whole pack."""
    unit: SystemdUnit | None = None
    """Systemd unit that runs the settings file; None without one."""

    @property
    def state_folder(self) -> Path:
        """Folder of the pack's checkpoints, which may not exist.

        Raises:
            RuntimeError: The folder is in a home folder, but the user has none.
        """
        if self.unit and self.unit.state_directory and not self.settings.state.folder:
            return STATE_ROOT / self.unit.state_directory
        return state_folder_path(self.settings).expanduser()

    @property
    def unit_cache_folder(self) -> Path | None:
        """Folder in which the systemd unit stores compiled kernels; None without a unit."""
        return CACHE_ROOT / self.unit.cache_directory if self.unit and self.unit.cache_directory else None

    @property
    def is_running(self) -> bool:
        """True if a process on this machine serves the pack."""
        try:
            return is_locked(self.state_folder, self.settings.pack.name)
        except RuntimeError:  # this user has no home folder, so that none of its processes has a state folder
            return False

    @property
    def command_as_root(self) -> str:
        """Command that examines the pack as root, who can read the folders of the systemd unit."""
        return shlex.join(root_command("doctor", self.path))

    @property
    def install_command(self) -> str:
        """Command that installs the service of the pack."""
        return shlex.join(root_command("install", self.path))


def is_root() -> bool:
    """Return True if this process runs as root."""
    return os.geteuid() == ROOT_USER


class Level(StrEnum):
    """Severity of a finding."""

    OK = "ok"
    WARNING = "warning"
    """Something may become a fault, or could not be checked."""
    FAULT = "fault"
    """The service cannot work as configured."""


@dataclass(frozen=True)
class Finding:
    """Result of a check."""

    check: str
    """Name of the check."""
    level: Level
    text: str
    """Description of the result."""
    remedy: str = ""
    """Instruction, if possible with a command to copy; empty if the level is ok."""


def ok(check: str, text: str) -> Finding:
    """Return a finding without a problem."""
    return Finding(check, Level.OK, text)


def warning(check: str, text: str, remedy: str) -> Finding:
    """Return a finding that may become a fault."""
    return Finding(check, Level.WARNING, text, remedy)


def fault(check: str, text: str, remedy: str) -> Finding:
    """Return a finding that keeps the service from working."""
    return Finding(check, Level.FAULT, text, remedy)
