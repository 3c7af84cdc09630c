"""Files and user of the service: units, drop-ins and udev rule."""

from dataclasses import dataclass
from pathlib import Path

from bms_estimator.installation import places
from bms_estimator.installation.machine import Machine

FILES = Path(__file__).parent / "files"
"""Folder with the original files."""
SYSUSERS_LINES = (f'u {places.NAME} - "Battery estimator" {places.STATE}', f"m {places.NAME} dialout")
"""Lines for systemd-sysusers that create the user of the service. Members of the group dialout may open serial ports."""
UNIT_PROGRAM = "/opt/bms-estimator/bin/bms-estimator"
"""Program in the original unit, which is replaced by the installed program."""


@dataclass(frozen=True)
class SystemFile:
    """File to be written.

    Attributes:
        kind: Kind of the file, for the output of ``install``.
        path: Absolute path on the machine.
        text: Content.
    """

    kind: str
    path: Path
    text: str


def system_files(machine: Machine, program: Path) -> list[SystemFile]:
    """Return the files that the service needs on a machine.

    Args:
        machine: Machine of the service.
        program: Absolute path of the program on the machine.
    """
    unit = (FILES / "bms-estimator.service").read_text(encoding="utf-8").replace(UNIT_PROGRAM, str(program))
    template = unit.replace(str(places.PACK_FILE), f"{places.SETTINGS}/%i.toml")
    rule = (FILES / "99-bms-estimator.rules").read_text(encoding="utf-8")
    files = [
        SystemFile("unit", places.UNIT, unit),
        SystemFile("unit", places.TEMPLATE, template),
        SystemFile("udev rule", places.UDEV_RULE, rule),
    ]
    if any(machine.path(daemon).exists() for daemon in places.CLOCK_DAEMONS):
        drop_in = (FILES / "clock.conf").read_text(encoding="utf-8")
        files += [SystemFile("unit", places.clock_drop_in(unit), drop_in) for unit in (places.UNIT, places.TEMPLATE)]
    return files
