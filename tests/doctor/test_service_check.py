"""Check of the systemd unit, from the output of ``systemctl show``."""

import sys
from pathlib import Path

import pytest

from bms_estimator.doctor.finding import Level
from bms_estimator.doctor.service_check import check_service, unit_finding
from bms_estimator.doctor.systemd_unit import parse_units
from bms_estimator.process.state_folder import instance_lock
from tests.doctor.packs import SYSTEMCTL_OUTPUT, subject, unit_with


def test_only_installed_units_count() -> None:
    (unit,) = parse_units(SYSTEMCTL_OUTPUT)
    assert (unit.name, unit.active_state, unit.is_enabled) == ("bms-estimator.service", "active", True)
    assert unit.status_text == "estimating house: SOC 81.2 %"
    assert "/etc/bms-estimator/pack.toml" in unit.command


@pytest.mark.parametrize(
    ("properties", "level", "text", "remedy"),
    [
        ({}, Level.OK, "runs; estimating house: SOC 81.2 %", ""),
        ({"NRestarts": "3", "StatusText": ""}, Level.OK, "runs, 3 restarts", ""),
        (
            {"ActiveState": "activating", "Result": "watchdog", "ExecMainStatus": "6"},
            Level.WARNING,
            "is starting; the last run ended with watchdog, status 6",
            "journalctl",
        ),
        (
            {"ActiveState": "activating", "Result": "exit-code", "ExecMainStatus": "75"},
            Level.WARNING,
            "is starting; the last run ended with a fault of the environment",
            "journalctl",
        ),
        ({"ActiveState": "inactive"}, Level.FAULT, "is stopped", "systemctl start"),
        (
            {"ActiveState": "failed", "Result": "exit-code", "ExecMainStatus": "2"},
            Level.FAULT,
            "invalid setting",
            "journalctl",
        ),
        (
            {"ActiveState": "failed", "Result": "oom-kill", "ExecMainStatus": "9"},
            Level.FAULT,
            "ended with oom-kill, status 9",
            "journalctl",
        ),
    ],
)
def test_a_unit_is_described_by_its_state_and_last_run(
    properties: dict[str, str], level: Level, text: str, remedy: str
) -> None:
    finding = unit_finding(unit_with(**properties))
    assert finding.level is level
    assert text in finding.text
    assert remedy in finding.remedy


def test_a_unit_that_does_not_start_with_the_machine_is_a_warning(tmp_path: Path) -> None:
    _, not_enabled = check_service(subject(tmp_path, unit=unit_with(UnitFileState="disabled")))
    assert (not_enabled.level, not_enabled.remedy) == (Level.WARNING, "sudo systemctl enable bms-estimator.service")


def test_without_a_unit_a_running_process_is_found(tmp_path: Path) -> None:
    pack = subject(tmp_path)
    (absent,) = check_service(pack)
    assert absent.level is Level.WARNING
    assert f"sudo {Path(sys.executable).parent}/bms-estimator install {pack.path};" in absent.remedy
    with instance_lock(pack.state_folder, "house"):
        (running,) = check_service(pack)
    assert (running.level, running.text) == (Level.OK, "runs, but not by systemd")
