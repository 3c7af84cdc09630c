"""Clocks of the host as a value, so that tests can replace them."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime


def since_boot() -> float:
    """Return the time since boot, including suspended time [s]. The load continues while the host is suspended."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


@dataclass(frozen=True)
class Clock:
    """Pair of clocks [s]. ``wall`` is the time of day, which may be set. ``monotonic`` is for durations, with suspended time."""

    wall: Callable[[], float] = time.time
    monotonic: Callable[[], float] = since_boot


def iso_utc(epoch_s: float) -> str:
    """Return seconds since 1970 in ISO 8601, UTC, with milliseconds: ``2024-05-01T12:00:00.250Z``."""
    return datetime.fromtimestamp(epoch_s, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
