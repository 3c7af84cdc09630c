"""``bms-estimator backup`` and ``restore``: settings and learned state of a pack in one file, to move it to another machine."""

import gzip
import io
import re
import tarfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from bms_estimator.installation import paths
from bms_estimator.installation.program_copy import named_files
from bms_estimator.model.config_file import parse_toml
from bms_estimator.model.errors import UserError
from bms_estimator.process.state_folder import instance_lock, state_folder_path, write_private
from bms_estimator.settings.pack import Settings, load_settings

SETTINGS, STATE = "settings", "state"
"""Folders in the archive."""
Pack = Annotated[Path, typer.Argument(metavar="PACK.toml", help="settings file of the pack")]
Archive = Annotated[Path, typer.Argument(metavar="FILE", help="archive, .tar.gz")]


def backup(pack: Pack, file: Archive) -> None:
    """Write the settings of a pack, its passwords and its learned state to one archive. Stop its service first.

    `restore` reads the archive on another machine.
    """
    settings = load_settings(pack)
    with _state_files(pack, settings) as (folder, files):
        if not files:
            raise UserError(
                f"{folder}: has no state of the pack {settings.pack.name}; run this command as the user that runs its service"
            )
        content = io.BytesIO()
        with tarfile.open(fileobj=content, mode="w:gz") as archive:
            archive.add(pack, f"{SETTINGS}/{pack.name}")
            for named in named_files(pack):
                archive.add(named, f"{SETTINGS}/{named.name}")
            for each in files:
                archive.add(each, f"{STATE}/{each.name}", recursive=False)
    with _user_errors(file):
        write_private(file, content.getvalue())
    typer.echo(f"{file}: {len(files)} files of the state of {settings.pack.name}, and its settings")


def restore(file: Archive, pack: Pack) -> None:
    """Restore the learned state of a pack from an archive of `backup`. Stop its service first.

    The settings of the archive are written if PACK.toml does not exist; otherwise they must have the same `pack.name`.
    A state that exists already is not replaced.
    """
    # decompressed whole, because tarfile does not check the checksum at the end
    with _user_errors(file), tarfile.open(fileobj=io.BytesIO(gzip.decompress(file.read_bytes()))) as archive:
        contents = {
            member.name: (archive.extractfile(member) or io.BytesIO()).read()
            for member in archive.getmembers()
            if member.isfile()
        }
    saved = {name.removeprefix(f"{STATE}/"): data for name, data in contents.items() if name.startswith(f"{STATE}/")}
    files = {Path(name).name: data for name, data in contents.items() if name.startswith(f"{SETTINGS}/")}
    if not saved or not files:
        raise UserError(f"{file}: is not an archive of bms-estimator backup")
    with _user_errors(file):
        text = files.pop(next(iter(files))).decode()  # backup adds the settings file first
    archived = parse_toml(text, Settings, str(file))
    settings = load_settings(pack) if pack.exists() else archived
    if settings.pack.name != archived.pack.name:
        raise UserError(
            f"{file}: archive of the pack {archived.pack.name}, but {pack} has pack.name = {settings.pack.name}"
        )
    for name in saved:
        if not _state_file_pattern(settings.pack.name).fullmatch(name):
            raise UserError(f"{file}: {name}: is not a file of the pack {settings.pack.name}")
    with _state_files(pack, settings) as (folder, existing):
        if existing:
            raise UserError(f"{existing[0]}: the pack has a state already; move it away to restore that of {file}")
        with _user_errors(pack.parent):
            pack.parent.mkdir(parents=True, exist_ok=True)
            for name, data in {} if pack.exists() else {**files, pack.name: text.encode()}.items():
                if not (pack.parent / name).exists():
                    write_private(pack.parent / name, data)
        with _user_errors(folder):
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            for name, data in saved.items():
                write_private(folder / name, data)
    typer.echo(f"{folder}: {len(saved)} files of the state of {settings.pack.name} restored; settings: {pack}")


@contextmanager
def _state_files(pack: Path, settings: Settings) -> Iterator[tuple[Path, list[Path]]]:
    """Yield the state folder of a pack and the files in it, while no service can run.

    Raises:
        UserError: The service of the pack runs, or the folder cannot be read.
    """
    is_installed = pack.resolve().parent == paths.SETTINGS and settings.state.folder is None
    folder = (paths.STATE if is_installed else state_folder_path(settings)).expanduser()
    with _user_errors(folder), instance_lock(folder, settings.pack.name):
        found = folder.iterdir() if folder.is_dir() else iter(())
        pattern = _state_file_pattern(settings.pack.name)
        yield folder, sorted(each for each in found if each.is_file() and pattern.fullmatch(each.name))


def _state_file_pattern(name: str) -> re.Pattern[str]:
    """Return the pattern of the names of the files of a pack's state.

    Another pack may be named ``NAME-0123abcd``, like a checkpoint of this pack. Its files have other suffixes.
    """
    return re.compile(rf"{re.escape(name)}(\.[a-z0-9.-]+|-[0-9a-f]{{8}}\.(((history|load)\.)?npz|changes-\d))")


@contextmanager
def _user_errors(path: Path) -> Iterator[None]:
    """Convert an error of a file or an archive to UserError."""
    try:
        yield
    except (OSError, tarfile.TarError, EOFError, zlib.error, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise UserError(f"{path}: {reason}") from None
