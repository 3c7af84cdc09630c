"""Timestamps that remain comparable across restarts, for the length of a gap."""

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
