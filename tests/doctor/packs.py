"""Packs and systemd units that the tests examine."""

from pathlib import Path
from typing import Any

from bms_estimator.doctor.finding import ExaminedPack
from bms_estimator.doctor.systemd_unit import SystemdUnit, parse_units
from bms_estimator.model.cell import load_cell
from bms_estimator.settings.pack import Settings

SYSTEMCTL_OUTPUT = """\
Id=bms-estimator.service
LoadState=loaded
ActiveState=active
UnitFileState=enabled
Result=success
ExecMainStatus=0
NRestarts=0
StatusText=estimating house: SOC 81.2 %
ExecStart={ path=/opt/bms-estimator/bin/bms-estimator ; argv[]=/opt/bms-estimator/bin/bms-estimator run /etc/bms-estimator/pack.toml ; }
StateDirectory=bms-estimator
CacheDirectory=bms-estimator

Id=bms-estimator@house.service
LoadState=not-found
ActiveState=inactive
UnitFileState=
Result=success
ExecMainStatus=0
NRestarts=0
StatusText=
ExecStart=
StateDirectory=
CacheDirectory=
"""
"""Output of ``systemctl show`` of systemd 252 for an installed unit and a missing one."""


def subject(folder: Path, *, unit: SystemdUnit | None = None, **sections: Any) -> ExaminedPack:
    """Return a pack ``house`` whose state folder is in ``folder``; ``sections`` are further sections of its settings file."""
    pack = {"name": "house", "cell": "lfp", "capacity_ah": 20.0, "series": 4}
    settings = Settings.model_validate({"pack": pack, "state": {"folder": folder / "state"}} | sections)
    return ExaminedPack(folder / "pack.toml", settings, load_cell("lfp", 20.0).pack(4, 1), unit)


def unit_with(**properties: str) -> SystemdUnit:
    """Return the installed unit with other properties."""
    lines = [line.partition("=") for line in SYSTEMCTL_OUTPUT.partition("\n\n")[0].splitlines()]
    text = "\n".join(f"{name}={properties.get(name, value)}" for name, _, value in lines)
    return next(parse_units(text))
