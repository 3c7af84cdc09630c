"""Systemd units, checked by systemd."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from bms_estimator.installation import paths
from bms_estimator.installation.install import system_files
from bms_estimator.installation.machine import Machine

MAX_EXPOSURE = 1.5
"""Maximum exposure by `systemd-analyze security`, of 0 to 10."""


@pytest.fixture(params=[paths.UNIT, paths.TEMPLATE], ids=["one pack", "several packs"])
def unit(request, tmp_path) -> Path:
    """Return the installed unit of one pack, or an instance of the template, with a program of this machine."""
    texts = {file.path: file.text for file in system_files(Machine(tmp_path), Path(sys.executable))}
    unit = tmp_path / request.param.name
    unit.write_text(texts[request.param])
    return unit.with_name(unit.name.replace("@", "@house"))


def verify(systemd_analyze: str, unit: Path) -> str:
    """Return systemd's messages about the unit. The exit code is not used, because it is 0 for unknown keys."""
    return subprocess.run([systemd_analyze, "verify", unit], capture_output=True, text=True, check=False).stderr


def exposure(systemd_analyze: str, unit: Path) -> float:
    """Return systemd's figure of the unit's exposure."""
    command = [systemd_analyze, "security", "--offline=true", "--no-pager", unit]
    text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    return float(re.search(r"Overall exposure level for \S+: ([0-9.]+)", text)[1])


def test_systemd_reports_no_error_in_the_unit(find_program, unit):
    assert verify(find_program("systemd-analyze", "systemd"), unit) == ""


def test_systemd_reports_a_misspelled_key(find_program, unit):
    file = unit.with_name(unit.name.replace("@house", "@"))
    file.write_text(file.read_text().replace("ProtectHome=", "ProtectHomes="))
    assert "ProtectHomes" in verify(find_program("systemd-analyze", "systemd"), unit)


@pytest.mark.parametrize(("device_group", "driver"), [("char-ttyACM", "cdc_acm"), ("char-ttyUSB", "usbserial")])
def test_usb_serial_driver_is_loaded_before_its_device_is_allowed(unit_text, device_group, driver):
    settings = [line.partition("=")[::2] for line in unit_text.splitlines()]
    assert f"{device_group} rw" in [value for key, value in settings if key == "DeviceAllow"]
    for relation in ("Wants", "After"):
        assert f"modprobe@{driver}.service" in " ".join(value for key, value in settings if key == relation).split()


def test_exposure_is_at_most_1_5(find_program, unit):
    assert exposure(find_program("systemd-analyze", "systemd"), unit) <= MAX_EXPOSURE


def test_memory_deny_write_execute_is_not_set(unit_text):
    """Check that MemoryDenyWriteExecute is not set, because the import of numba fails under it."""
    keys = [line.split("=")[0] for line in unit_text.splitlines()]
    assert "MemoryDenyWriteExecute" not in keys


def test_memory_of_the_service_is_limited(unit_text):
    assert "\nMemoryMax=1G\n" in unit_text
