"""Check of the cache of compiled kernels: complete, writable, and free of other versions."""

import os
import shlex
from collections.abc import Iterator
from pathlib import Path

from bms_estimator.doctor.finding import ExaminedPack, Finding, ok, warning
from bms_estimator.installation.machine import root_command
from bms_estimator.numba_cache import SHIPPED_FOLDER, cache_folders, source_digest
from bms_estimator.process.memory import available_bytes
from bms_estimator.service.kernel_compilation import CHILD_BYTES, COMPLETE_FILE

NAME = "kernel cache"
MAX_OTHER_VERSIONS = 3
"""Maximum number of folders with kernels of other versions without a warning. Each may take more than 100 MB."""


def check_kernels(subject: ExaminedPack | None) -> Iterator[Finding]:
    """Yield findings on the compiled kernels, and on the folder in which they are stored."""
    if (SHIPPED_FOLDER / COMPLETE_FILE).exists():
        yield ok(NAME, f"{SHIPPED_FOLDER}: compiled kernels of the package")
        return
    folder = (subject and subject.unit_cache_folder) or _own_cache_folder()
    if folder is None:
        text = "no folder can be written: every start compiles the kernels, which may take minutes"
        yield warning(NAME, text, "set a folder that can be written: export NUMBA_CACHE_DIR=FOLDER")
        return
    version_folder = folder / source_digest()
    if not os.access(folder, os.R_OK | os.X_OK):
        yield warning(NAME, f"{folder}: cannot be read by this user; not checked", _command_as_root(subject))
        return
    size_mb = size_of(version_folder) / 1e6
    if (version_folder / COMPLETE_FILE).exists():
        yield ok(NAME, f"{version_folder}: compiled, {size_mb:.0f} MB")
    else:
        text = f"{version_folder}: not compiled yet: the first start may take minutes"
        yield warning(NAME, text, "start the service, or run once: bms-estimator compile")
        if (available := available_bytes()) < CHILD_BYTES:
            text = f"compiling needs {CHILD_BYTES >> 20} MiB of memory, and {available >> 20} MiB are available"
            yield warning(
                NAME, text, "end other programs, add swap, or install the Debian package, which compiles nothing"
            )
    other_versions = [each for each in folder.iterdir() if each.is_dir() and each != version_folder]
    if len(other_versions) > MAX_OTHER_VERSIONS:
        command = f"find {folder} -mindepth 1 -maxdepth 1 ! -name {version_folder.name} -exec rm -r {{}} +"
        remedy = f"{command}  # other installed versions then compile theirs again"
        yield warning(NAME, f"{folder}: kernels of {len(other_versions)} other versions take space", remedy)


def size_of(folder: Path) -> int:
    """Return the size of all files below a folder [bytes]; 0 if it does not exist."""
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())


def _own_cache_folder() -> Path | None:
    """Return the first cache folder that this user can write; None without one."""
    return next((folder for folder in cache_folders() if os.access(folder, os.W_OK | os.X_OK)), None)


def _command_as_root(subject: ExaminedPack | None) -> str:
    return subject.command_as_root if subject else shlex.join(root_command("doctor"))
