"""Check of the state folder: permissions, and space for checkpoints and history."""

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from bms_estimator.doctor.finding import Finding, fault, ok, warning
from bms_estimator.doctor.subject import Subject

NAME = "state folder"
HISTORY_MB_PER_DAY = 0.2
"""Size of the history of a day [MB]: 72 MB a year."""
CHECKPOINTS_MB = 10.0
"""Size of checkpoints, temporary files and the queue of a short outage [MB]."""


def check_disk(subject: Subject) -> Iterator[Finding]:
    """Yield whether the state folder can be written, and whether the disk has room for the history."""
    folder = subject.state_folder
    existing = _nearest_existing(folder)
    if not os.access(existing, os.R_OK | os.W_OK | os.X_OK):
        if subject.unit:  # the folder belongs to the service's user
            yield warning(NAME, f"{folder}: cannot be read by this user; not checked", subject.command_as_root)
        else:
            remedy = f"let this user write it: sudo chown {os.geteuid()} {existing}; or set state.folder"
            yield fault(NAME, f"{existing}: this user may not write it", remedy)
        return
    free_mb = shutil.disk_usage(existing).free / 1e6
    used_mb = _size_mb(folder)
    needed_mb = CHECKPOINTS_MB + max(HISTORY_MB_PER_DAY * subject.settings.store.history_days - used_mb, 0.0)
    text = f"{folder}: {used_mb:.0f} MB used, {free_mb:,.0f} MB free"
    if free_mb < CHECKPOINTS_MB:
        yield fault(NAME, f"{text}: the disk is full", f"free some space: sudo du -xh {existing} | sort -h | tail")
    elif free_mb < needed_mb:
        text += f", but a history of {subject.settings.store.history_days} days needs {needed_mb:,.0f} MB"
        yield warning(NAME, text, "free some space, or set a smaller store.history_days")
    else:
        yield ok(NAME, text)


def _nearest_existing(folder: Path) -> Path:
    """Return the folder, or its nearest parent that exists."""
    return next(each for each in (folder, *folder.parents) if os.path.lexists(each))


def _size_mb(folder: Path) -> float:
    """Return the size of all files in a folder [MB]; 0 if it does not exist."""
    return sum(file.stat().st_size for file in folder.glob("*") if file.is_file()) / 1e6
