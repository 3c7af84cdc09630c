"""State folder of a service."""

import os
from pathlib import Path

import structlog

from bms_estimator.model.errors import TemporaryError
from bms_estimator.settings.pack import Settings

log = structlog.get_logger(__name__)


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
