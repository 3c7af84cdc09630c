"""Check of the board: nothing is sent to other devices, and with ``port = "auto"`` only one board is read.

More tests of the check are in ``test_pinned_board``.
"""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from serial.tools import list_ports

from bms_estimator.model.arrays import SampleBlock
from bms_estimator.protocols.firmware.messages import hello_command
from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.simulation.virtual_adc import Reading
from bms_estimator.simulation.virtual_board import VirtualBoard
from bms_estimator.sources.serial import port_list
from bms_estimator.sources.serial.serial_source import SerialSource
from tests.patience import until
from tests.serial_line import Line, usb_port
from tests.sources.serial.test_serial_source import run_tasks, store_blocks

ASH_RESET = b"\x1a\xc1\x02\x0b\x0a\x52\x7e"
"""Bytes that a Zigbee stick sends after its reset."""


@contextlib.asynccontextmanager
async def run_source(source: SerialSource, blocks: list[SampleBlock]):
    """Run the source. Append its blocks to ``blocks``."""
    async with source, run_tasks(store_blocks(source, blocks)):
        yield


async def test_nothing_is_sent_to_a_device_that_is_silent_or_has_another_protocol(line: Line) -> None:
    line.plug()
    source = SerialSource(SensorSettings(port=str(line.path)), first_retry_s=0.05, silent_s=0.3)
    async with run_source(source, []):
        await until(lambda: source.silence_reason and "silent" in source.silence_reason)
        assert line.received() == b""
        line.write(100 * ASH_RESET)
        await until(lambda: source.silence_reason and "no valid frame" in source.silence_reason)
        assert line.received() == b""


async def test_hello_is_requested_after_the_first_frame(line: Line) -> None:
    line.plug()
    source = SerialSource(SensorSettings(port=str(line.path)), first_retry_s=0.05)
    async with run_source(source, []):
        await until(lambda: source.silence_reason and "no frame yet" in source.silence_reason)
        line.write(b"\0" + hello_command())  # any frame with a valid CRC
        received = b""

        def is_requested() -> bool:
            nonlocal received
            received += line.received()
            return received.startswith(hello_command())

        await until(is_requested)


@pytest.fixture
def only_port(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Path]:
    """Return the path of the only port. It exists while a board is plugged in."""
    path = tmp_path / "ttyUSB0"
    monkeypatch.setattr(list_ports, "comports", lambda: [usb_port(str(path))] if path.is_symlink() else [])
    monkeypatch.setattr(port_list, "BY_ID", tmp_path / "by-id")
    return path


@contextlib.contextmanager
def symlink(path: Path, target: str):
    """Create a link, and remove it at the end."""
    path.symlink_to(target)
    try:
        yield
    finally:
        path.unlink()


@contextlib.asynccontextmanager
async def plugged_in(path: Path, serial: int, voltage_v: float = 22.2):
    """Run a board that is plugged in at ``path``."""
    reading = Reading(current_a=0.5, voltage_v=voltage_v, temperature_c=25.0)
    with VirtualBoard(lambda _: reading, serial=serial) as board, symlink(path, board.path):
        async with run_tasks(board.run()):
            yield


async def test_auto_rejects_another_board_and_reopens_its_own(only_port: Path) -> None:
    blocks = list[SampleBlock]()
    source = SerialSource(SensorSettings(port="auto", sample_rate_hz=50), first_retry_s=0.05)
    async with run_source(source, blocks):
        async with plugged_in(only_port, serial=1):
            await until(lambda: source.board_check.serial)
        await until(lambda: source.silence_reason)
        async with plugged_in(only_port, serial=2, voltage_v=11.1):
            await until(lambda: source.silence_reason and "refused" in source.silence_reason)
            assert "board 00000002 is not the pack's, 00000001" in (source.silence_reason or "")
            await until(lambda: source.counters["reconnects"] >= 2)  # the board is checked a second time
        blocks_before = len(blocks)
        async with plugged_in(only_port, serial=1):
            await until(lambda: len(blocks) > blocks_before)
        assert source.board["serial"] == "00000001"
    assert np.concatenate(blocks)["voltage_v"] == pytest.approx(22.2, abs=0.1)


async def test_auto_reports_a_board_that_prints_text_in_place_of_its_own(only_port: Path) -> None:
    source = SerialSource(SensorSettings(port="auto"), first_retry_s=0.05, silent_s=0.3)
    async with run_source(source, []):
        async with plugged_in(only_port, serial=1):
            await until(lambda: source.board_check.serial)
        await until(lambda: source.silence_reason)
        with VirtualBoard(lambda _: Reading(0.5, 22.2), mode="text") as other, symlink(only_port, other.path):
            async with run_tasks(other.run()):
                await until(lambda: source.silence_reason and "prints text" in source.silence_reason)
