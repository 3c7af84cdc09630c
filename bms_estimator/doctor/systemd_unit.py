"""Systemd unit that runs a settings file, as ``systemctl show`` describes it."""

import subprocess
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

TIMEOUT_S = 3.0
"""Timeout of ``systemctl`` [s]."""
RUNNING_SYSTEMD = Path("/run/systemd/system")
"""Folder that exists while systemd is the init system."""
PROPERTIES = (
    "Id",
    "LoadState",
    "ActiveState",
    "UnitFileState",
    "Result",
    "ExecMainStatus",
    "NRestarts",
    "StatusText",
    "ExecStart",
    "StateDirectory",
    "CacheDirectory",
)


@dataclass(frozen=True)
class SystemdUnit:
    """Installed systemd unit."""

    name: str
    active_state: str
    """``active``, ``activating``, ``failed``, ``inactive``, and so on."""
    is_enabled: bool
    """True if the unit starts with the machine."""
    result: str
    """Result of the last run: ``success``, ``exit-code``, ``watchdog``, ``signal``, and so on."""
    exit_status: int
    """Exit code, or number of the signal, of the last run."""
    restarts: int
    """Number of automatic restarts since the last start by a user or the system."""
    status_text: str
    """Status that the service reports itself."""
    command: str
    """Command that the unit runs, in the form of ``systemctl show``."""
    state_directory: str
    """Name of the folder below /var/lib; empty without one."""
    cache_directory: str
    """Name of the folder below /var/cache; empty without one."""


def unit_of(pack: Path) -> SystemdUnit | None:
    """Return the unit that runs the settings file ``pack``; None without systemd or without such a unit.

    Raises:
        OSError: ``systemctl`` cannot be run.
        subprocess.TimeoutExpired: ``systemctl`` does not answer.
    """
    if not RUNNING_SYSTEMD.is_dir():
        return None
    names = ("bms-estimator.service", f"bms-estimator@{pack.stem}.service")
    command = ["systemctl", "show", f"--property={','.join(PROPERTIES)}", *names]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=TIMEOUT_S)  # noqa: S603 - a fixed program
    units = parse_units(done.stdout)
    return next((unit for unit in units if str(pack.resolve()) in unit.command), None)


def parse_units(text: str) -> Iterator[SystemdUnit]:
    """Yield the installed units in the output of ``systemctl show``, in which empty lines separate units."""
    for block in text.strip().split("\n\n"):
        properties = dict(line.split("=", 1) for line in block.splitlines() if "=" in line)
        if properties.get("LoadState") == "loaded":
            yield _unit(properties)


def _unit(properties: Mapping[str, str]) -> SystemdUnit:
    return SystemdUnit(
        name=properties.get("Id", ""),
        active_state=properties.get("ActiveState", ""),
        is_enabled=properties.get("UnitFileState", "").startswith("enabled"),
        result=properties.get("Result", ""),
        exit_status=int(properties.get("ExecMainStatus") or 0),
        restarts=int(properties.get("NRestarts") or 0),
        status_text=properties.get("StatusText", ""),
        command=properties.get("ExecStart", ""),
        state_directory=properties.get("StateDirectory", ""),
        cache_directory=properties.get("CacheDirectory", ""),
    )
