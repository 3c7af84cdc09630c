"""Timestamps that outlive the process, which give the length of unmeasured gaps."""

import ctypes
import math
import os
import time
from dataclasses import dataclass
from pathlib import Path

from bms_estimator.model.clock import since_boot

BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
TIMESYNCD = Path("/run/systemd/timesync/synchronized")
"""File that exists once systemd-timesyncd has set the clock since boot."""
TIME_ERROR = 5
"""Return value of adjtimex(2) while nothing sets the wall clock."""
TIMEX_BYTES = 512
"""More than a ``struct timex`` has anywhere."""


@dataclass(frozen=True)
class BootTimestamp:
    """Timestamp that outlives the process, and maybe a reboot.

    Attributes:
        wall_s: Wall clock [s since 1970]. Without a battery the clock stops while the machine is off.
        synchronised: Whether the wall clock is known to be right.
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


def synchronised() -> bool:
    """Return True if the wall clock counts as synchronized.

    By the kernel, or by systemd-timesyncd if the kernel may not be queried.
    """
    only_read = ctypes.create_string_buffer(TIMEX_BYTES)
    state = int(ctypes.CDLL(None).adjtimex(only_read))
    return TIMESYNCD.exists() if state < 0 else state < TIME_ERROR


def boot_timestamp() -> BootTimestamp:
    """Now. The unit hides /proc/sys and passes the boot id in ``BMS_BOOT_ID``."""
    boot = os.environ.get("BMS_BOOT_ID") or (BOOT_ID.read_text(encoding="ascii") if BOOT_ID.exists() else "")
    return BootTimestamp(
        wall_s=time.time(),
        synchronised=synchronised(),
        boot_s=since_boot(),
        boot=boot.strip().replace("-", ""),
    )
