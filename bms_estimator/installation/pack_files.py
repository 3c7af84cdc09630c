"""Files of a pack to be installed: its settings, and the files that the settings name."""

from collections.abc import Iterator
from pathlib import Path

from pydantic import BaseModel

from bms_estimator.model.config_file import read_toml
from bms_estimator.model.errors import UserError
from bms_estimator.settings.pack import Settings

HIDDEN_FOLDERS = (Path("/home"), Path("/root"), Path("/run/user"), Path("/tmp"), Path("/var/tmp"))  # noqa: S108
"""Folders that the unit hides from the service by ProtectHome and PrivateTmp."""


def is_hidden_from_services(path: Path) -> bool:
    """Return True if the service cannot see a file."""
    return any(path.is_relative_to(folder) for folder in HIDDEN_FOLDERS)


def named_files(pack: Path) -> list[Path]:
    """Return the files that a pack's settings name and that must be copied with the pack file.

    The files are in the folder of the pack file. A name without such a file may be a systemd credential or a generic cell.

    Args:
        pack: Settings file of the pack.

    Raises:
        UserError: The settings are invalid, or a file is in a folder that the service cannot see.
    """
    files = []
    for key, name in _paths_in(read_toml(pack, Settings)):
        if name.is_absolute():
            if is_hidden_from_services(name.resolve()):
                raise UserError(
                    f"{pack}: {key} = {name}: the service cannot read this folder; "
                    f"move the file beside {pack.name}, and write {key} = {name.name}"
                )
        elif (file := pack.parent / name).is_file():
            if len(name.parts) > 1:
                raise UserError(f"{pack}: {key} = {name}: move the file beside {pack.name}, and give only its name")
            files.append(file)
    return list(dict.fromkeys(files))


def _paths_in(settings: Settings) -> Iterator[tuple[str, Path]]:
    """Yield key and path of each file that settings may name."""
    yield "pack.cell", Path(settings.pack.cell)
    for name in Settings.model_fields:
        section = getattr(settings, name)
        if isinstance(section, BaseModel):
            yield from _paths_of_section(name, section)


def _paths_of_section(prefix: str, section: BaseModel) -> Iterator[tuple[str, Path]]:
    """Yield key and path of each file that a section or one of its subsections may name."""
    for key in type(section).model_fields:
        value = getattr(section, key)
        if isinstance(value, Path):
            yield f"{prefix}.{key}", value
        elif isinstance(value, BaseModel):
            yield from _paths_of_section(f"{prefix}.{key}", value)
