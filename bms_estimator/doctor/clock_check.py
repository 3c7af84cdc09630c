"""Check of the wall clock: whether it is synchronized, and whether the service can detect that."""

import shlex
from collections.abc import Iterator
from pathlib import Path

from bms_estimator.doctor.finding import Finding, ok, warning
from bms_estimator.doctor.subject import Subject
from bms_estimator.installation import places
from bms_estimator.installation.root_command import root_command
from bms_estimator.process.boot_clock import TIMESYNCD, synchronised

NAME = "clock"
REAL_TIME_CLOCK = Path("/dev/rtc0")
"""Clock with a battery."""


def check_clock(subject: Subject | None) -> Iterator[Finding]:
    """Yield whether the clock is synchronized, and whether the service can detect that."""
    hardware = "a clock with a battery" if REAL_TIME_CLOCK.exists() else "no clock with a battery"
    if synchronised():
        yield ok(NAME, f"synchronized; {hardware}")
    else:
        text = f"not synchronized; {hardware}: the length of a power-off counts as unknown"
        yield warning(NAME, text, "sudo timedatectl set-ntp true; in a container: synchronize the host")
    if subject and subject.unit and synchronised() and not TIMESYNCD.exists():
        drop_in = places.clock_drop_in(places.TEMPLATE if "@" in subject.unit.name else places.UNIT)
        if not drop_in.exists():
            text = "the service cannot see that the clock is synchronized, because systemd-timesyncd does not run"
            yield warning(NAME, text, f"{shlex.join(root_command('install'))}, which adds {drop_in.name} to the unit")
