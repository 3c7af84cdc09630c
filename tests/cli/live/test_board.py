"""``board``: properties, settings, and errors."""

import asyncio
import contextlib
import os
import threading

import pytest
from serial.tools import list_ports

from bms_estimator.cli.main import main
from bms_estimator.simulation.virtual_adc import BoardParts, Reading
from bms_estimator.simulation.virtual_board import VirtualBoard
from bms_estimator.sources.serial import device_detection
from tests.patience import LONG_S
from tests.serial_line import usb_port


def board(capsys, *arguments):
    """Exit code, stdout, stderr of the command."""
    with pytest.raises(SystemExit) as ended:
        main(["board", *arguments])
    out, err = capsys.readouterr()
    return ended.value.code or 0, out, err


@contextlib.contextmanager
def virtual(**options):
    """Path of a board that runs in a thread."""
    with VirtualBoard(lambda _: Reading(2.5, 22.2, 25.0), **options) as made:
        loop = asyncio.new_event_loop()
        task = loop.create_task(made.run())
        thread = threading.Thread(target=loop.run_until_complete, args=(asyncio.wait([task]),))
        thread.start()
        yield made.path
        loop.call_soon_threadsafe(task.cancel)
        thread.join()
        loop.close()


@pytest.fixture
def patient(monkeypatch):
    """For boards that answer."""
    monkeypatch.setattr(device_detection, "BOOT_TIMEOUT_S", LONG_S)
    monkeypatch.setattr(device_detection, "REFERENCE_TIMEOUT_S", LONG_S)


@pytest.fixture
def impatient(monkeypatch):
    """For those that never do."""
    monkeypatch.setattr(device_detection, "BOOT_TIMEOUT_S", 0.5)


@pytest.mark.usefixtures("patient")
def test_it_shows_what_the_board_says_of_itself(capsys):
    with virtual(rate_hz=50, serial=0xC0FFEE, parts=BoardParts(supply_v=4.8)) as path:
        code, out, err = board(capsys, path)
    assert (code, err) == (0, "")
    said = dict(line.split(maxsplit=1) for line in out.splitlines())
    assert (said["firmware"], said["serial"], said["rate"]) == ("0.2.0", "00c0ffee", "50 Hz")
    assert (said["voltage"], said["bandgap"]) == ("divider 6.1", "1.1000 V")
    assert said["current"] == "0.1 V/A at 5 V, ratiometric, zero at 0.500000 of the reference"
    assert float(said["reference"].split()[0]) == pytest.approx(4.8, rel=1e-3)


@pytest.mark.usefixtures("patient")
def test_the_voltage_at_aref_sets_the_bandgap_and_with_it_the_reference(capsys):
    with virtual(rate_hz=50) as path:
        code, out, err = board(capsys, path, "--aref-v", "4.7", "--serial", "77")
        assert (code, err) == (0, "")
        bandgap, serial = out.splitlines()[-2:]
        assert bandgap.startswith("bandgap: was 1.1000 V, now ")
        assert float(bandgap.split()[-2]) == pytest.approx(1.1 * 4.7 / 5.0, rel=1e-3)
        assert serial == "serial: was 00000001, now 0000004d"
        _, out, _ = board(capsys, path)
    said = dict(line.split(maxsplit=1) for line in out.splitlines())
    assert said["serial"] == "0000004d"
    assert float(said["reference"].split()[0]) == pytest.approx(4.7, rel=1e-3)


@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize("aref_v", ["3.3", "6", "0", "-5"])
def test_a_voltage_that_cannot_be_at_aref_changes_nothing(capsys, monkeypatch, aref_v):
    monkeypatch.setattr(device_detection, "REFERENCE_SAMPLES", 10)
    with virtual() as path:
        code, _, err = board(capsys, path, "--aref-v", aref_v, "--serial", "7")
        assert code == 2
        assert err.startswith(f"error: --aref-v {aref_v}: ")
        assert "between 1.0 and 1.2 V" in err
        _, out, _ = board(capsys, path)
    assert "bandgap    1.1000 V" in out
    assert "serial     00000001" in out


@pytest.mark.parametrize("serial", ["0", "-1", "4294967296", "x"])
def test_a_serial_number_that_the_board_cannot_hold(capsys, serial):
    code, out, err = board(capsys, "/dev/none", "--serial", serial)
    assert (code, out) == (2, "")
    assert "--serial" in err


@pytest.mark.usefixtures("patient")
def test_a_board_that_prints_text_takes_no_commands(capsys):
    with virtual(mode="text") as path:
        code, out, err = board(capsys, path, "--serial", "7")
    assert (code, out) == (2, "")
    assert err.startswith(f"error: {path}: the board prints text, not frames")
    assert err.endswith("it takes no commands\n")


@pytest.mark.usefixtures("impatient")
def test_a_port_on_which_nobody_is(capsys):
    master, slave = os.openpty()
    path = os.ttyname(slave)
    try:
        assert board(capsys, path) == (2, "", f"error: {path}: silent\n")
    finally:
        os.close(slave)
        os.close(master)


def test_a_port_that_is_not_there(capsys, tmp_path, monkeypatch):
    path = tmp_path / "none"
    assert board(capsys, str(path)) == (2, "", f"error: {path}: it does not exist\n")
    monkeypatch.setattr(list_ports, "comports", list)
    assert board(capsys) == (2, "", "error: auto: no USB serial port is connected\n")
    monkeypatch.setattr(list_ports, "comports", lambda: [usb_port("/dev/a"), usb_port("/dev/b")])
    assert board(capsys) == (2, "", "error: auto: 2 serial ports are connected; choose one: /dev/a, /dev/b\n")


def test_a_port_that_is_none(capsys, tmp_path):
    path = tmp_path / "file"
    path.write_text("")
    code, out, err = board(capsys, str(path))
    assert (code, out) == (2, "")
    assert err.startswith(f"error: {path}: cannot be opened: ")
