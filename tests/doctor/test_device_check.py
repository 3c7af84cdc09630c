"""Check of the device, with a simulated board on a pseudo-terminal."""

import asyncio
import os
import re
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from bms_estimator.doctor import device_check
from bms_estimator.doctor.device_check import check_board, check_device, first_sample_timeout_s
from bms_estimator.doctor.finding import Level
from bms_estimator.model.cell import load_cell
from bms_estimator.process.state_folder import instance_lock
from bms_estimator.simulation.simulated_pack import SimulatedBms
from bms_estimator.simulation.virtual_adc import Reading
from bms_estimator.simulation.virtual_board import VirtualBoard
from bms_estimator.sources.serial.port_list import KnownBoardFile
from tests.device_line import running_device
from tests.doctor.as_user import as_nobody
from tests.doctor.packs import subject
from tests.patience import LONG_S
from tests.serial_line import Line

BOARD = {"serial": "0000002a", "divider": "6.1", "volts_per_ampere": "0.1", "bandgap_v": "1.083"}
"""Properties of a calibrated board."""


@pytest.fixture
def board_port(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Run a board with 13.2 V and 0.5 A, and return its port."""
    monkeypatch.setattr(device_check, "MIN_FIRST_SAMPLE_TIMEOUT_S", LONG_S)
    with VirtualBoard(lambda _: Reading(current_a=0.5, voltage_v=13.2, temperature_c=25.0), serial=42) as board:
        loop = asyncio.new_event_loop()
        task = loop.create_task(board.run())
        thread = threading.Thread(target=loop.run_until_complete, args=(asyncio.wait([task]),))
        thread.start()
        yield board.path
        loop.call_soon_threadsafe(task.cancel)
        thread.join()
        loop.close()


@pytest.mark.parametrize(
    ("capacity_ah", "doubt"), [(20.0, ""), (5.0, "; without cell voltages, 5 in series cannot be excluded")]
)
def test_a_board_that_answers_is_reported_with_its_values(
    tmp_path: Path, board_port: str, capacity_ah: float, doubt: str
) -> None:
    """The voltage at rest shows the number of cells; 0.5 A are a load for 5 Ah."""
    pack = replace(subject(tmp_path, sensor={"port": board_port}), model=load_cell("lfp", capacity_ah).pack(4, 1))
    device, board = check_device(pack)
    assert device.level is Level.OK
    assert re.fullmatch(
        rf"{board_port}: 13\.[12]\d+ V, 0\.\d+ A; firmware 0\.2\.0, serial 0000002a{doubt}",
        device.text,
    )
    assert (board.check, board.level) == ("board", Level.WARNING)
    assert "--aref-v" in board.remedy
    assert not (tmp_path / "state").exists()  # nothing is written


def test_a_silent_device_is_a_fault(tmp_path: Path, line: Line, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device_check, "MIN_FIRST_SAMPLE_TIMEOUT_S", 0.2)
    line.plug()
    (device,) = check_device(subject(tmp_path, sensor={"port": str(line.path)}))
    assert device.level is Level.FAULT
    assert "no frame yet" in device.text
    assert "ports --probe" in device.remedy


@pytest.mark.parametrize(
    ("source", "wait_s"), [({}, 8.0), ({"interval_s": 30.0}, 60.0), ({"max_silent_s": 90.0}, 90.0)]
)
def test_a_source_has_time_for_two_samples_and_for_its_longest_silence(
    tmp_path: Path, source: dict[str, float], wait_s: float
) -> None:
    mqtt = {"kind": "mqtt", "topic": "bms", "voltage": "v", "current": "i", "interval_s": 1.0} | source
    assert first_sample_timeout_s(subject(tmp_path, source=mqtt).settings) == wait_s


def test_another_number_of_cells_than_in_series_is_a_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device_check, "MIN_FIRST_SAMPLE_TIMEOUT_S", LONG_S)
    monkeypatch.setattr(device_check, "CELLS_TIMEOUT_S", 0.1)
    bms = SimulatedBms("jk", lambda _: Reading(current_a=5.0, voltage_v=16.5, temperature_c=25.0), cells=5)
    with running_device(bms) as port:
        device, capacity, series, cells = check_device(subject(tmp_path, sensor={"port": port, "protocol": "jk"}))
    assert device.level is Level.OK
    assert capacity.text == "pack.capacity_ah: the pack has 20 Ah, but its device reports 100 Ah"
    assert series.text.startswith("pack.series = 4: 16.50 V are 4.12 V a cell")
    assert "5 in series is likely" in series.text
    assert (cells.level, cells.text) == (Level.WARNING, "5 cells are measured, but the pack has 4 in series")


def test_a_missing_port_is_reported_only_by_the_check_of_the_port(tmp_path: Path) -> None:
    assert list(check_device(subject(tmp_path, sensor={"port": "/dev/absent"}))) == []
    assert list(check_device(subject(tmp_path, sensor={"port": "/dev"}))) == []


def test_the_port_of_a_running_service_is_not_opened(tmp_path: Path, line: Line) -> None:
    line.plug()
    pack = subject(tmp_path, sensor={"port": str(line.path)})
    service = os.open(line.path, os.O_RDWR | os.O_NOCTTY)
    with instance_lock(pack.state_folder, "house"):
        (device,) = check_device(pack)
    assert (device.level, device.text) == (Level.WARNING, "in use by the running service; not examined")
    assert line.received() == b""
    os.close(service)


def test_a_calibrated_board_is_compared_with_the_stored_board(tmp_path: Path) -> None:
    pack = subject(tmp_path)
    (calibrated,) = check_board(pack, BOARD)
    assert (calibrated.level, calibrated.text) == (
        Level.OK,
        "calibrated: divider 6.1, volts_per_ampere 0.1, bandgap_v 1.083",
    )
    file = KnownBoardFile(pack.state_folder, "house")
    file.save(BOARD | {"bandgap_v": "1.1"})
    _, changed = check_board(pack, BOARD)
    assert (changed.level, "bandgap_v 1.1 to 1.083" in changed.text) == (Level.WARNING, True)
    file.save(BOARD | {"serial": "0000002b"})
    _, other = check_board(pack, BOARD)
    assert (other.level, other.text) == (Level.FAULT, "board 0000002a is connected, but the pack's is 0000002b")
    assert f"board --folder {pack.state_folder} --accept {pack.path}" in other.remedy


def test_an_unreadable_stored_board_is_a_warning(tmp_path: Path) -> None:
    pack = subject(tmp_path)
    KnownBoardFile(pack.state_folder, "house").save(BOARD)
    pack.state_folder.chmod(0o000)
    _, unread = as_nobody(lambda: list(check_board(pack, BOARD)))
    pack.state_folder.chmod(0o700)
    assert (unread.level, unread.remedy) == (Level.WARNING, pack.command_as_root)
