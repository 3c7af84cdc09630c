"""Check of the serial port: existence, permissions, udev rule."""

import os
import stat
from pathlib import Path

import pytest
from serial.tools import list_ports

from bms_estimator.doctor import port_check
from bms_estimator.doctor.finding import Level
from bms_estimator.doctor.port_check import check_port, may_open
from bms_estimator.installation import paths
from bms_estimator.sources.serial import port_list
from tests.doctor.as_user import as_nobody
from tests.doctor.packs import subject
from tests.serial_line import Line, usb_port

OWNER, GROUP, OTHER = 1000, 20, 1001
"""User and group of a port, and another user."""


@pytest.mark.parametrize(
    ("mode", "user", "groups", "allowed"),
    [
        (0o660, OWNER, set(), True),
        (0o060, OWNER, {GROUP}, False),  # only the owner's bits count for the owner
        (0o660, OTHER, {GROUP}, True),
        (0o640, OTHER, {GROUP}, False),
        (0o606, OTHER, {GROUP}, False),  # only the group's bits count for a member of the group
        (0o606, OTHER, set(), True),
        (0o660, OTHER, set(), False),
        (0o000, 0, set(), True),
    ],
)
def test_a_port_may_be_opened_by_owner_group_or_others(mode: int, user: int, groups: set[int], allowed: bool) -> None:
    status = os.stat_result((stat.S_IFCHR | mode, 0, 0, 1, OWNER, GROUP, 0, 0, 0, 0))
    assert may_open(status, user, groups) is allowed


def test_a_port_of_another_user_is_a_fault_with_the_command_that_adds_the_user_to_the_group(
    tmp_path: Path, line: Line
) -> None:
    line.plug()
    line.path.chmod(0o660)
    tmp_path.chmod(0o755)
    pack = subject(tmp_path, sensor={"port": os.path.realpath(line.path)})
    if os.geteuid() == 0:
        os.chown(line.path, 0, GROUP)
        (finding,) = as_nobody(lambda: list(check_port(pack)))
        assert finding.level is Level.FAULT
        assert "cannot be opened by nobody (root:" in finding.text
        assert "sudo usermod -aG dialout nobody" in finding.remedy
    (finding,) = check_port(pack)
    assert finding.level is Level.OK


@pytest.mark.parametrize(
    ("port", "text"),
    [("/dev/absent", "/dev/absent: it does not exist"), ("/dev/..", "/dev/..: it is not a serial port")],
)
def test_a_missing_port_and_a_folder_are_faults(tmp_path: Path, port: str, text: str) -> None:
    (finding,) = check_port(subject(tmp_path, sensor={"port": port}))
    assert (finding.level, finding.text) == (Level.FAULT, text)
    assert "bms-estimator ports" in finding.remedy


@pytest.mark.parametrize(("is_installed", "level"), [(True, Level.OK), (False, Level.WARNING)])
def test_the_udev_rule_of_a_usb_port_is_looked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_installed: bool, level: Level
) -> None:
    port = tmp_path / "ttyUSB0"
    port.touch()
    monkeypatch.setattr(list_ports, "comports", lambda: [usb_port(str(port))])
    monkeypatch.setattr(port_list, "BY_ID", tmp_path / "by-id")
    monkeypatch.setattr(port_check, "RULE_FOLDERS", (tmp_path,))
    if is_installed:
        (tmp_path / paths.UDEV_RULE.name).touch()
    _, rule = check_port(subject(tmp_path, sensor={"port": "auto"}))
    assert (rule.check, rule.level) == ("udev rule", level)


def test_a_source_without_a_port_has_no_finding(tmp_path: Path) -> None:
    assert list(check_port(subject(tmp_path, source={"kind": "linux"}))) == []
