"""``board``: it shows the properties of a board, changes its settings, and reports errors."""

import asyncio
import contextlib
import os
import threading

import pytest
from serial.tools import list_ports

from bms_estimator.simulation.virtual_adc import BoardParts, Reading
from bms_estimator.simulation.virtual_board import VirtualBoard
from bms_estimator.sources.serial import device_detection
from tests.command_line import error, run
from tests.patience import LONG_S
from tests.serial_line import usb_port


@contextlib.contextmanager
def running_board(**options):
    """Run a virtual board in a thread. Yield the path of its line."""
    with VirtualBoard(lambda _: Reading(2.5, 22.2, 25.0), **options) as virtual_board:
        loop = asyncio.new_event_loop()
        task = loop.create_task(virtual_board.run())
        thread = threading.Thread(target=loop.run_until_complete, args=(asyncio.wait([task]),))
        thread.start()
        yield virtual_board.path
        loop.call_soon_threadsafe(task.cancel)
        thread.join()
        loop.close()


@pytest.fixture
def long_timeouts(monkeypatch):
    """Set timeouts that are too long for a responding board to reach."""
    monkeypatch.setattr(device_detection, "BOOT_TIMEOUT_S", LONG_S)
    monkeypatch.setattr(device_detection, "REFERENCE_TIMEOUT_S", LONG_S)


@pytest.fixture
def short_timeouts(monkeypatch):
    """Set short timeouts, for boards that do not respond."""
    monkeypatch.setattr(device_detection, "BOOT_TIMEOUT_S", 0.5)


@pytest.mark.usefixtures("long_timeouts")
def test_command_shows_the_properties_of_the_board(capsys):
    with running_board(rate_hz=50, serial=0xC0FFEE, parts=BoardParts(supply_v=4.8)) as path:
        code, out, err = run(capsys, "board", path)
    assert (code, err) == (0, "")
    shown = dict(line.split(maxsplit=1) for line in out.splitlines())
    assert (shown["firmware"], shown["serial"], shown["rate"]) == ("0.2.0", "00c0ffee", "50 Hz")
    assert (shown["voltage"], shown["bandgap"]) == ("divider 6.1", "1.1000 V")
    assert shown["current"] == "0.1 V/A at 5 V, ratiometric, zero at 0.500000 of the reference"
    assert float(shown["reference"].split()[0]) == pytest.approx(4.8, rel=1e-3)


@pytest.mark.usefixtures("long_timeouts")
def test_given_voltage_at_aref_sets_the_bandgap_and_so_the_reference(capsys):
    with running_board(rate_hz=50) as path:
        code, out, err = run(capsys, "board", path, "--aref-v", "4.7", "--serial", "77")
        assert (code, err) == (0, "")
        bandgap, serial = out.splitlines()[-2:]
        assert bandgap.startswith("bandgap: was 1.1000 V, now ")
        assert float(bandgap.split()[-2]) == pytest.approx(1.1 * 4.7 / 5.0, rel=1e-3)
        assert serial == "serial: was 00000001, now 0000004d"
        _, out, _ = run(capsys, "board", path)
    shown = dict(line.split(maxsplit=1) for line in out.splitlines())
    assert shown["serial"] == "0000004d"
    assert float(shown["reference"].split()[0]) == pytest.approx(4.7, rel=1e-3)


@pytest.mark.usefixtures("long_timeouts")
@pytest.mark.parametrize("aref_v", ["3.3", "6", "0", "-5"])
def test_implausible_voltage_at_aref_is_rejected(capsys, monkeypatch, aref_v):
    monkeypatch.setattr(device_detection, "REFERENCE_SAMPLES", 10)
    with running_board() as path:
        err = error(run(capsys, "board", path, "--aref-v", aref_v, "--serial", "7"))
        assert err.startswith(f"error: --aref-v {aref_v}: ")
        assert "between 1.0 and 1.2 V" in err
        _, out, _ = run(capsys, "board", path)
    assert "bandgap    1.1000 V" in out
    assert "serial     00000001" in out


@pytest.mark.parametrize("serial", ["0", "-1", "4294967296", "x"])
def test_serial_number_out_of_range_is_rejected(capsys, serial):
    code, out, err = run(capsys, "board", "/dev/none", "--serial", serial)
    assert (code, out) == (2, "")
    assert "--serial" in err


@pytest.mark.usefixtures("long_timeouts")
def test_text_board_rejects_commands(capsys):
    with running_board(mode="text") as path:
        code, out, err = run(capsys, "board", path, "--serial", "7")
    assert (code, out) == (2, "")
    assert err.startswith(f"error: {path}: the board prints text, not frames")
    assert err.endswith("it takes no commands\n")


@pytest.mark.usefixtures("short_timeouts")
def test_port_without_a_board_is_reported(capsys):
    master, slave = os.openpty()
    path = os.ttyname(slave)
    try:
        assert run(capsys, "board", path) == (2, "", f"error: {path}: silent\n")
    finally:
        os.close(slave)
        os.close(master)


def test_missing_port_is_reported(capsys, tmp_path, monkeypatch):
    path = tmp_path / "none"
    assert run(capsys, "board", str(path)) == (2, "", f"error: {path}: it does not exist\n")
    monkeypatch.setattr(list_ports, "comports", list)
    assert run(capsys, "board") == (2, "", "error: auto: no USB serial port is connected\n")
    monkeypatch.setattr(list_ports, "comports", lambda: [usb_port("/dev/a"), usb_port("/dev/b")])
    assert run(capsys, "board") == (2, "", "error: auto: 2 serial ports are connected; choose one: /dev/a, /dev/b\n")


def test_file_that_is_no_port_is_reported(capsys, tmp_path):
    path = tmp_path / "file"
    path.write_text("[pack]\n")
    code, out, err = run(capsys, "board", str(path))
    assert (code, out) == (2, "")
    assert err.startswith(f"error: {path}: it is not a serial port")
