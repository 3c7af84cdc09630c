"""The clocks, taken as a value so that tests can step them."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime


@dataclass(frozen=True)
class Clock:
    """Two clocks: ``wall`` gives the time of day (and may be stepped), ``monotonic`` gives durations."""

    wall: Callable[[], float] = time.time
    monotonic: Callable[[], float] = time.monotonic

    def utc(self) -> str:
        """Wall clock now, ISO 8601."""
        return iso_utc(self.wall())


def since_boot() -> float:
    """Return the time since boot [s]; it never steps and counts while the machine sleeps, as the cell does not sleep."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def iso_utc(epoch_s: float) -> str:
    """Seconds since 1970 as ISO 8601 in UTC with milliseconds: ``2024-05-01T12:00:00.250Z``."""
    return datetime.fromtimestamp(epoch_s, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
