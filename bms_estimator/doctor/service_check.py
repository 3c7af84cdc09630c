"""Check of the service: systemd unit installed, running, and the outcome of its last run."""

import os
from collections.abc import Iterator

from bms_estimator.doctor.finding import ExaminedPack, Finding, fault, ok, warning
from bms_estimator.doctor.systemd_unit import SystemdUnit
from bms_estimator.process.memory import has_memory_groups

NAME = "service"
INVALID_SETTING = 2
"""Exit code of the service for an invalid setting, after which systemd does not restart it."""


def check_service(subject: ExaminedPack) -> Iterator[Finding]:
    """Yield findings on the service of the pack and its systemd unit."""
    unit = subject.unit
    if unit is None:
        if subject.is_running:
            yield ok(NAME, "runs, but not by systemd")
        else:
            text = f"does not run, and no systemd unit runs {subject.path}"
            yield warning(NAME, text, f"{subject.install_command}; or: bms-estimator run {subject.path}")
        return
    yield unit_finding(unit)
    if not has_memory_groups():
        text = f"the kernel limits no memory: MemoryMax of {unit.name} has no effect"
        yield warning(
            NAME, text, "on a Raspberry Pi, append cgroup_enable=memory to /boot/firmware/cmdline.txt, and reboot"
        )
    if not unit.is_enabled:
        text = f"{unit.name}: does not start with the machine"
        yield warning(NAME, text, f"sudo systemctl enable {unit.name}")


def unit_finding(unit: SystemdUnit) -> Finding:
    """Return the finding on the state of a systemd unit, and on the end of its last run."""
    restarts = f", {unit.restarts} restarts" if unit.restarts else ""
    journal = f"journalctl -u {unit.name} -n 20"
    if unit.active_state == "active":
        status = f"; {unit.status_text}" if unit.status_text else ""
        return ok(NAME, f"{unit.name}: runs{restarts}{status}")
    if unit.active_state in ("activating", "reloading"):
        text = f"{unit.name}: is starting{restarts}; the last run ended with {_outcome_text(unit)}"
        return warning(NAME, text, f"the reason is in its log: {journal}")
    if unit.result == "success" and unit.exit_status == 0:
        return fault(NAME, f"{unit.name}: is stopped", f"sudo systemctl start {unit.name}")
    if unit.exit_status == INVALID_SETTING:
        return fault(NAME, f"{unit.name}: ended because of an invalid setting", f"the setting is in its log: {journal}")
    return fault(NAME, f"{unit.name}: ended with {_outcome_text(unit)}", f"the reason is in its log: {journal}")


def _outcome_text(unit: SystemdUnit) -> str:
    """Return the outcome of a unit's last run as text."""
    if unit.exit_status == os.EX_TEMPFAIL:
        return f"a fault of the environment, such as a missing file or a second process for the pack (status {unit.exit_status})"
    return f"{unit.result}, status {unit.exit_status}"
