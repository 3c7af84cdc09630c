"""New settings file of a pack."""

import os
from pathlib import Path
from types import MappingProxyType

from bms_estimator.model.errors import UserError
from bms_estimator.settings.pack import Settings
from bms_estimator.settings.settings_template import GivenSettings, settings_file


def create_pack_file(path: Path, given: GivenSettings = MappingProxyType({})) -> None:
    """Write a new settings file that lists every setting; only ``given`` settings differ from the defaults.

    Raises:
        UserError: The file exists already, or cannot be written.
    """
    require_new(path)
    try:
        with path.open("x", encoding="utf-8") as file:
            try:
                file.write(settings_file(Settings, given))
                file.flush()
            except OSError:
                path.unlink()  # a part of the file would prevent the next attempt
                raise
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}") from None


def require_new(path: Path) -> None:
    """Reject the path of a file that exists, or that cannot be created.

    Raises:
        UserError: The file exists, or its folder does not exist or cannot be written.
    """
    if os.path.lexists(path):
        raise UserError(f"{path}: exists already and is not changed; give another name")
    if not path.parent.is_dir():
        raise UserError(f"{path}: cannot be written: there is no folder {path.parent}; create it, or give another name")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise UserError(f"{path}: cannot be written: no permission to write to the folder {path.parent.resolve()}")
