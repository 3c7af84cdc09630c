"""Host of this process: its memory, and timestamps that remain comparable across restarts, for the length of a gap."""

import contextlib
import ctypes
import math
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from bms_estimator.model.clock import since_boot

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


BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
TIMESYNCD = Path("/run/systemd/timesync/synchronized")
"""File that exists once systemd-timesyncd has set the clock since boot."""
TIME_ERROR = 5
"""Return value of adjtimex(2) while the wall clock is not synchronized."""
TIMEX_BYTES = 512
"""Buffer size for a ``struct timex`` [bytes], larger than on any platform."""


@dataclass(frozen=True)
class BootTimestamp:
    """Timestamp that can be compared after a restart of the process, and after a reboot if the wall clock was right.

    Attributes:
        wall_s: Wall clock [s since 1970]. It stops while a machine without a clock battery is off.
        synchronised: True if the wall clock is synchronized.
        boot_s: Time since the machine started, including suspend [s].
        boot: Identifier of the boot; empty if unknown.
    """

    wall_s: float
    synchronised: bool
    boot_s: float
    boot: str

    def since(self, before: "BootTimestamp") -> float:
        """Return the time since ``before`` [s]; infinite if unknown."""
        if self.boot and self.boot == before.boot:
            return self.boot_s - before.boot_s
        passed_s = self.wall_s - before.wall_s
        return passed_s if passed_s >= 0.0 and self.synchronised and before.synchronised else math.inf


def is_clock_synchronized() -> bool:
    """Return True if the wall clock counts as synchronized.

    The kernel reports it, or systemd-timesyncd if the kernel must not be queried.
    """
    timex = ctypes.create_string_buffer(TIMEX_BYTES)
    state = int(ctypes.CDLL(None).adjtimex(timex))
    return TIMESYNCD.exists() if state < 0 else state < TIME_ERROR


def boot_timestamp() -> BootTimestamp:
    """Return the present timestamp.

    The systemd unit hides /proc/sys, and passes the boot id in ``BMS_BOOT_ID``.
    """
    boot = os.environ.get("BMS_BOOT_ID") or (BOOT_ID.read_text(encoding="ascii") if BOOT_ID.exists() else "")
    return BootTimestamp(
        wall_s=time.time(),
        synchronised=is_clock_synchronized(),
        boot_s=since_boot(),
        boot=boot.strip().replace("-", ""),
    )
