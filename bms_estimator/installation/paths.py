"""Names and absolute paths of the installed service."""

from pathlib import Path

NAME = "bms-estimator"
"""Name of the program, the service, its user and its group."""
PACK_FILE = Path("/etc/bms-estimator/pack.toml")
"""Settings file of the service ``bms-estimator``."""
SETTINGS = PACK_FILE.parent
"""Folder of the settings, which the service can read and only root can write."""
STATE = Path("/var/lib/bms-estimator")
"""Folder of checkpoints and history, created by systemd."""
CACHE = Path("/var/cache/bms-estimator")
"""Folder of compiled kernels, created by systemd."""
UNIT = Path("/etc/systemd/system/bms-estimator.service")
"""Unit of one pack."""
TEMPLATE = Path("/etc/systemd/system/bms-estimator@.service")
"""Template of units for several packs: ``bms-estimator@NAME`` serves ``NAME.toml`` in the folder of the settings."""
UDEV_RULE = Path("/etc/udev/rules.d/99-bms-estimator.rules")
"""Rule that names sensor boards on USB."""
CLOCK_DAEMONS = (Path("/usr/sbin/chronyd"), Path("/usr/sbin/ntpd"))
"""Programs that set the clock in place of systemd-timesyncd."""
PROGRAM_COPY = Path("/opt/bms-estimator")
"""Virtual environment for a copy of a program that is installed in a home folder, where services cannot read it."""
PROGRAM_LINK = Path("/usr/local/bin/bms-estimator")
"""Link to a program that is not in the search path."""
SEARCH_PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
"""Search path of root."""


def drop_ins(unit: Path) -> Path:
    """Return the folder of a unit's drop-ins."""
    return unit.with_name(f"{unit.name}.d")


def clock_drop_in(unit: Path) -> Path:
    """Return the drop-in that permits a unit to query the clock's state from the kernel."""
    return drop_ins(unit) / "clock.conf"
