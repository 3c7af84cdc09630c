"""Memory of this process, of the machine, and of control groups."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

CGROUPS = Path("/sys/fs/cgroup")
"""Folder of the control groups: version 2, or version 1 with a folder for each controller."""


def anonymous_bytes() -> int:
    """Return the memory of this process that no file backs [bytes]."""
    return _kib_of(Path("/proc/self/status"), "RssAnon") * 1024


def available_bytes() -> int:
    """Return the memory that this process can use without swapping, within the limits of machine and control groups [bytes]."""
    try:
        machine = _kib_of(Path("/proc/meminfo"), "MemAvailable") * 1024
    except FileNotFoundError:  # ProcSubset=pid of a systemd unit hides the file; half of the RAM counts as available
        machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2
    return max(0, min([machine, *_available_in_groups()]))


def has_memory_groups(groups: Path = CGROUPS) -> bool:
    """Return True if control groups can limit memory. On Raspberry Pi OS they cannot by default."""
    controllers = groups / "cgroup.controllers"
    if controllers.exists():  # version 2
        return "memory" in controllers.read_text(encoding="ascii").split()
    return (groups / "memory").is_dir()


def _kib_of(file: Path, name: str) -> int:
    """Return a value of a file of lines like ``RssAnon:  1024 kB``; 0 without such a line."""
    lines = file.read_text(encoding="utf-8").splitlines()
    return next((int(line.split()[1]) for line in lines if line.startswith(f"{name}:")), 0)


def _available_in_groups() -> Iterator[int]:
    """Yield limit less use of each control group of this process that has a limit [bytes]."""
    for line in Path("/proc/self/cgroup").read_text(encoding="utf-8").splitlines():
        _, controllers, path = line.split(":", 2)
        if controllers == "":
            yield from _available_in_parents(CGROUPS, path, "memory.max", "anon")
        elif "memory" in controllers.split(","):
            yield from _available_in_parents(CGROUPS / "memory", path, "memory.limit_in_bytes", "total_rss")


def _available_in_parents(root: Path, path: str, limit_file: str, used: str) -> Iterator[int]:
    """Yield limit less use of the group ``path`` and of each of its parents that has a limit [bytes]."""
    group = root / path.lstrip("/")
    for folder in (group, *group.parents):
        if folder.is_relative_to(root):
            with contextlib.suppress(OSError, ValueError):  # no such file, or the limit "max"
                limit = int((folder / limit_file).read_text(encoding="ascii"))
                statistics = (folder / "memory.stat").read_text(encoding="ascii").splitlines()
                yield limit - sum(int(line.split()[1]) for line in statistics if line.startswith(f"{used} "))
