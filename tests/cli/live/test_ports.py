"""``ports``: existing ports, their holders, and the devices on them."""

import contextlib
import os
import re
import subprocess

import pytest
from serial.tools import list_ports

from tests.command_line import PROGRAM, run
from tests.patience import LONG_S


@pytest.fixture(autouse=True)
def wide_terminal(monkeypatch):
    """Set a wide terminal, so that table cells are not wrapped."""
    monkeypatch.setenv("COLUMNS", "240")


def run_ports(capsys, *arguments):
    """Run the command, which must not write to stderr. Return exit code and stdout."""
    code, out, err = run(capsys, "ports", *arguments)
    assert err == ""
    return code, out


@contextlib.contextmanager
def simulated_board(*arguments):
    """Run a simulated board as a process. Yield the path of its line and the process."""
    with subprocess.Popen([PROGRAM, "simulate", *arguments], stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process.stdout.readline().strip(), process
        finally:
            process.kill()


def test_existing_ports_are_listed(capsys):
    devices = [port.device for port in list_ports.comports()]
    code, out = run_ports(capsys)
    assert code == 0
    if devices:  # this machine may have ports
        assert len(re.findall(r"^ *(/dev/\S+)", out, re.MULTILINE)) == len(devices)
        assert "board" not in out.splitlines()[1]
    else:
        assert out == "there is no serial port; is the board plugged in?\n"


@pytest.mark.parametrize(
    ("options", "description"),
    [
        (("--rate-hz", "50"), r"board, firmware 0\.2\.0, serial 0*1, 50 Hz"),
        (("--text", "--load", "constant", "--current-a", "0"), r"prints text, [34]\S* V, \S+ A"),
    ],
)
def test_probe_identifies_a_board_without_disturbing_it(capsys, monkeypatch, options, description):
    monkeypatch.setattr("bms_estimator.sources.serial.device_detection.BOOT_TIMEOUT_S", LONG_S)
    with simulated_board(*options) as (path, process):
        for _ in range(2):
            code, out = run_ports(capsys, "--probe", path)
            assert code == 0
            assert re.search(rf"^ *{path} .* {description} *$", out, re.MULTILINE)
            assert f"(pid {process.pid})" in out
        assert process.poll() is None


def test_other_devices_are_not_identified_as_boards(capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "500")  # rows are not wrapped
    monkeypatch.setattr("bms_estimator.sources.serial.device_detection.BOOT_TIMEOUT_S", 0.3)
    monkeypatch.setattr("bms_estimator.sources.serial.device_detection.PROTOCOL_TIMEOUT_S", 0.1)
    master, slave = os.openpty()
    try:
        silent = os.ttyname(slave)
        code, out = run_ports(capsys, "--probe", silent, str(tmp_path / "none"))
    finally:
        os.close(master)
        os.close(slave)
    assert code == 0
    rows = {line.split()[0]: line for line in out.splitlines() if line.strip().startswith("/")}
    assert set(rows) == {silent, str(tmp_path / "none")}
    assert "firmware" not in out
    assert re.search(r"silent|no board answers", rows[silent])
    assert "cannot be opened" in rows[str(tmp_path / "none")]


def test_ports_are_opened_only_with_probe(capsys, tmp_path):
    code, out = run_ports(capsys, str(tmp_path / "none"))
    assert code == 0
    assert "cannot be opened" not in out
    assert str(tmp_path / "none") in out
