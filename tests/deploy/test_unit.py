"""The systemd unit, judged by systemd."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

HIGHEST_EXPOSURE = 1.5


@pytest.fixture(params=["bms-estimator.service", "bms-estimator@house.service"])
def unit(request, deploy, tmp_path) -> Path:
    """The unit with a program that exists here: of one pack, or the instance of a template for one of several."""
    template = request.param.replace("house", "")
    files = [deploy / template, *deploy.glob(f"{template}.d/*.conf")]
    assert len(files) == (2 if "@" in template else 1)
    for file in files:
        text, changed = re.subn(r"(?m)^ExecStart=/\S+", f"ExecStart={sys.executable}", file.read_text())
        assert changed == 1
        path = tmp_path / file.relative_to(deploy)
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    return tmp_path / request.param


def verify(systemd_analyze: str, unit: Path) -> str:
    """Return systemd's messages about the units. Its exit code is 0 for unknown keys, so only its words count."""
    return subprocess.run([systemd_analyze, "verify", unit], capture_output=True, text=True, check=False).stderr


def test_systemd_finds_nothing_wrong_in_the_unit(program, unit):
    assert verify(program("systemd-analyze", "systemd"), unit) == ""


def test_systemd_would_find_a_misspelled_key(program, unit):
    file = unit.with_name(unit.name.replace("house", ""))
    file.write_text(file.read_text().replace("ProtectHome=", "ProtectHomes="))
    assert "ProtectHomes" in verify(program("systemd-analyze", "systemd"), unit)


@pytest.mark.parametrize(("kind", "driver"), [("char-ttyACM", "cdc_acm"), ("char-ttyUSB", "usbserial")])
def test_the_driver_of_each_kind_of_usb_line_is_loaded_before_its_device_is_allowed(deploy, kind, driver):
    settings = [line.partition("=")[::2] for line in (deploy / "bms-estimator.service").read_text().splitlines()]
    assert f"{kind} rw" in [value for key, value in settings if key == "DeviceAllow"]
    for relation in ("Wants", "After"):
        assert f"modprobe@{driver}.service" in " ".join(value for key, value in settings if key == relation).split()


def test_exposure_is_at_most_1_5(program, unit):
    command = [program("systemd-analyze", "systemd"), "security", "--offline=true", "--no-pager", unit]
    text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    found = re.search(r"Overall exposure level for \S+: ([0-9.]+)", text)
    assert found, text
    assert float(found[1]) <= HIGHEST_EXPOSURE


def test_machine_code_may_be_made_at_run_time(deploy):
    """Import numba fails under MemoryDenyWriteExecute, so it must never be switched on."""
    keys = [line.split("=")[0] for line in (deploy / "bms-estimator.service").read_text().splitlines()]
    assert "MemoryDenyWriteExecute" not in keys


def test_a_flood_ends_the_service_and_not_the_machine(deploy):
    assert "\nMemoryMax=1G\n" in (deploy / "bms-estimator.service").read_text()
