"""Board of a pack. It is recognized by its serial number on any port, and other boards are rejected."""

import asyncio
import contextlib
import json
import os
import shutil
import stat
import tty
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from serial.tools import list_ports
from structlog.testing import capture_logs

from bms_estimator.model.arrays import SampleBlock
from bms_estimator.model.clock import since_boot
from bms_estimator.process.runtime import end_tasks
from bms_estimator.protocols.firmware.messages import MessageType
from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.simulation.virtual_adc import BoardParts, Reading
from bms_estimator.simulation.virtual_board import VirtualBoard
from bms_estimator.sources.serial import board_check, port_list, serial_source
from bms_estimator.sources.serial.port_list import NO_BOARD, KnownBoardFile
from bms_estimator.sources.serial.serial_port import SILENT_PORT_RETRY_S
from bms_estimator.sources.serial.serial_source import SerialSource
from tests.command_line import error, run
from tests.patience import until
from tests.serial_line import usb_port

OURS_V, OTHERS_V = 22.2, 11.1
"""Voltages that the pack's board and another board measure [V]. By default they have serial numbers 1 and 2."""
BOARD_42 = NO_BOARD | {"serial": "0000002a", "divider": "5", "volts_per_ampere": "0.1", "bandgap_v": "1.1"}
"""Stored fields of a board with serial number 42."""


@pytest.fixture
def port_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Return the folder of the ports. Each link in the folder is a USB port with the chip of a board."""
    ports = tmp_path / "dev"
    ports.mkdir()
    monkeypatch.setattr(list_ports, "comports", lambda: [usb_port(str(path)) for path in ports.iterdir()])
    monkeypatch.setattr(port_list, "BY_ID", tmp_path / "by-id")
    monkeypatch.setattr(serial_source, "SEND_INTERVAL_S", 0.02)
    return ports


@pytest.fixture
def memory(tmp_path: Path) -> KnownBoardFile:
    """Return the file that stores the board of pack ``house``; it does not exist yet."""
    return KnownBoardFile(tmp_path, "house")


class RecordingSource(SerialSource):
    """Serial source that stores its blocks."""

    blocks: list[SampleBlock]

    @property
    def voltage_v(self) -> float:
        """Voltage of the last sample [V]; NaN before the first one."""
        return float(self.blocks[-1]["voltage_v"][-1]) if self.blocks else float("nan")


@contextlib.asynccontextmanager
async def source(
    port: Path | str,
    memory: KnownBoardFile | None = None,
    monotonic: Callable[[], float] = since_boot,
    **settings: Any,
) -> AsyncIterator[RecordingSource]:
    """Run a source that stores its blocks."""
    reader = RecordingSource(
        SensorSettings(port=str(port), **settings),
        board_file=memory,
        monotonic=monotonic,
        first_retry_s=0.05,
        silent_s=0.3,
    )
    reader.blocks = []

    async def store_blocks() -> None:
        async for block, *_ in reader:
            reader.blocks.append(block.copy())

    async with reader:
        task = asyncio.create_task(store_blocks())
        try:
            yield reader
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)


@contextlib.asynccontextmanager
async def board(path: Path, serial: int = 1, voltage_v: float = OURS_V, **options: Any) -> AsyncIterator[VirtualBoard]:
    """Run a board that is plugged in at ``path``."""
    with VirtualBoard(
        lambda _: Reading(current_a=0.5, voltage_v=voltage_v, temperature_c=25.0), serial=serial, **options
    ) as virtual:
        path.symlink_to(virtual.path)  # noqa: ASYNC240 - at once
        task = asyncio.create_task(virtual.run())
        try:
            yield virtual
        finally:
            path.unlink()  # noqa: ASYNC240
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)


async def wait_until_stored(memory: KnownBoardFile, serial: str) -> None:
    """Wait until the file contains the board with this serial number."""
    await until(lambda: memory.load().get("serial") == serial)


async def test_other_board_on_the_configured_port_is_rejected_after_a_restart(
    port_folder: Path, memory: KnownBoardFile
) -> None:
    port = port_folder / "ttyUSB0"
    async with source(port, memory), board(port):
        await wait_until_stored(memory, "00000001")
    async with source(port, memory) as reader, board(port, serial=2, voltage_v=OTHERS_V):
        await until(lambda: reader.silence_reason and "refused" in reader.silence_reason)
        reason = "refused: board 00000002 is not the pack's, 00000001"
        remedy = "connect that one, or, to use this board instead, run"
        assert f"{port}: {reason}: {remedy}" in (reader.silence_reason or "")
        assert f"`bms-estimator board --folder {memory.path.parent} --accept`" in (reader.silence_reason or "")
        await until(lambda: reader.counters["reconnects"] >= 1)
        assert reader.blocks == []


async def test_first_board_is_rejected_if_the_settings_name_another_serial_number(
    port_folder: Path, memory: KnownBoardFile
) -> None:
    port = port_folder / "ttyUSB0"
    async with source(port, memory, serial="0000002a") as reader:
        async with board(port, voltage_v=OTHERS_V):
            await until(lambda: reader.silence_reason and "refused" in reader.silence_reason)
            assert "board 00000001 is not the pack's, 0000002a" in (reader.silence_reason or "")
            assert "set sensor.serial" in (reader.silence_reason or "")
        async with board(port, serial=42):
            await until(lambda: reader.blocks)
        assert reader.voltage_v == pytest.approx(OURS_V, abs=0.1)


async def test_board_without_serial_number_is_accepted_with_a_warning_unless_one_is_configured(
    port_folder: Path, memory: KnownBoardFile
) -> None:
    port = port_folder / "ttyUSB0"
    with capture_logs() as logs:
        async with source(port, memory) as reader, board(port, serial=0):
            await until(lambda: [line for line in logs if "no serial number" in line["event"]])
            assert reader.board["serial"] == ""
    assert memory.load() == {}
    async with source(port, memory, serial="00000001") as reader, board(port, serial=0):
        await until(lambda: "board without a serial number is not the pack's" in (reader.silence_reason or ""))


async def test_other_board_plugged_into_the_adapter_of_the_open_port_is_rejected(port_folder: Path) -> None:
    """The port remains open. Only the hello shows that the board was replaced."""
    port = port_folder / "ttyUSB0"
    async with source(port) as reader, board(port) as virtual:
        await until(lambda: reader.board_check.serial)
        virtual._stored[MessageType.COMMAND_SET_SERIAL] = 2
        other_board = VirtualBoard(lambda _: Reading(current_a=0.5, voltage_v=1.0), parts=BoardParts(divider=9.0))
        virtual._converter = other_board._converter
        virtual.reset()
        await until(
            lambda: reader.silence_reason and "board 00000002 is not the pack's, 00000001" in reader.silence_reason
        )
    assert np.concatenate(reader.blocks)["voltage_v"] == pytest.approx(OURS_V, abs=0.1)


async def test_own_board_is_found_on_another_port_among_other_boards(port_folder: Path, memory: KnownBoardFile) -> None:
    port = port_folder / "ttyUSB0"
    async with source(port, memory) as reader:
        async with board(port):
            await until(lambda: reader.board_check.serial)
        await until(lambda: reader.silence_reason)
        blocks_before = len(reader.blocks)
        async with board(port_folder / "ttyUSB1", serial=2, voltage_v=OTHERS_V), board(port_folder / "ttyUSB2"):
            await until(lambda: len(reader.blocks) > blocks_before)
        blocks_before = len(reader.blocks)
        async with board(port):  # back on the first port
            await until(lambda: len(reader.blocks) > blocks_before)
    assert np.concatenate(reader.blocks)["voltage_v"] == pytest.approx(OURS_V, abs=0.1)


async def test_two_packs_find_their_boards_among_all_ports(port_folder: Path) -> None:
    async with (
        source("auto", serial="00000001") as house,
        source("auto", serial="00000002") as shed,
        board(port_folder / "a", serial=2, voltage_v=OTHERS_V),
        board(port_folder / "b", serial=1),
    ):
        await until(lambda: house.blocks and shed.blocks)
    assert np.concatenate(house.blocks)["voltage_v"] == pytest.approx(OURS_V, abs=0.1)
    assert np.concatenate(shed.blocks)["voltage_v"] == pytest.approx(OTHERS_V, abs=0.1)


async def test_search_for_the_board_sends_nothing_to_a_silent_device(port_folder: Path) -> None:
    master, slave = os.openpty()
    tty.setraw(slave)
    (port_folder / "ttyUSB0").symlink_to(os.ttyname(slave))
    os.set_blocking(master, False)
    try:
        async with source(port_folder / "gone", serial="00000001") as reader:
            await until(lambda: reader._discovery._skipped)  # the silent device was tried
            async with board(port_folder / "ttyUSB1"):
                await until(lambda: reader.blocks)
        with pytest.raises(BlockingIOError):
            os.read(master, 1)
    finally:
        os.close(slave)
        os.close(master)


async def test_board_that_started_after_its_port_was_opened_is_found_before_other_devices_are_tried_again(
    port_folder: Path,
) -> None:
    now_s = 0.0
    async with source(port_folder / "gone", serial="00000001", monotonic=lambda: now_s) as reader:
        with VirtualBoard(lambda _: Reading(current_a=0.5, voltage_v=OURS_V, temperature_c=25.0)) as late:
            (port_folder / "a").symlink_to(late.path)
            async with board(port_folder / "b", serial=2):
                await until(lambda: reader._path == str(port_folder / "a"))
                now_s = 1.0  # more than the time after which the port counts as silent
                await until(lambda: len(reader._discovery._skipped) == 2)
                starting = asyncio.create_task(late.run())
                now_s += SILENT_PORT_RETRY_S
                await until(lambda: reader.blocks)
                await end_tasks(starting)


async def test_changed_calibration_is_reported_before_it_is_stored(
    port_folder: Path, memory: KnownBoardFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(board_check, "STORE_RETRY_S", 0.05)
    port = port_folder / "ttyUSB0"
    async with source(port, memory), board(port):
        await wait_until_stored(memory, "00000001")
    with capture_logs() as logs:
        async with source(port, memory) as reader, board(port, parts=BoardParts(divider=5.4)):
            await until(lambda: memory.load().get("divider") == "5.4")
            assert reader.blocks
    (line,) = [line for line in logs if line["event"] == "the board is calibrated differently"]
    assert line["divider"] == "6.1 to 5.4"  # the default divider is 6.1
    assert "serial" not in line


async def test_running_service_uses_a_newly_accepted_board(
    port_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    memory, port = KnownBoardFile(tmp_path, "house"), port_folder / "ttyUSB0"
    pack = tmp_path / "pack.toml"
    pack.write_text(f'[pack]\nname = "house"\n[state]\nfolder = "{tmp_path}"\n')
    async with source(port, memory) as reader:
        async with board(port):
            await wait_until_stored(memory, "00000001")
        async with board(port, serial=2, voltage_v=OTHERS_V):
            await until(lambda: reader.silence_reason and "refused" in reader.silence_reason)
            code, text, _ = run(capsys, "board", "--accept", pack)
            assert code == 0
            assert f"{memory.path}: board 00000001 removed; the service accepts the next board that connects\n" in text
            await wait_until_stored(memory, "00000002")
            assert reader.voltage_v == pytest.approx(OTHERS_V, abs=0.1)


async def test_other_board_is_rejected_after_the_board_file_was_deleted_within_a_run(
    port_folder: Path, memory: KnownBoardFile
) -> None:
    port = port_folder / "ttyUSB0"
    async with source(port, memory) as reader:
        async with board(port):
            await wait_until_stored(memory, "00000001")
        memory.path.unlink()
        async with board(port, serial=2):
            await until(lambda: reader.silence_reason and "refused" in reader.silence_reason)
            reconnects_before = reader.counters["reconnects"]
            await until(lambda: reader.counters["reconnects"] > reconnects_before)
            # the board of the new connection is not known until its hello
            await until(lambda: reader.silence_reason and "refused" in reader.silence_reason)


async def test_board_that_prints_text_is_accepted_although_another_board_is_stored(
    port_folder: Path, memory: KnownBoardFile
) -> None:
    port = port_folder / "ttyUSB0"
    memory.save(BOARD_42)
    async with source(port, memory, protocol="text") as reader, board(port, mode="text"):
        await until(lambda: reader.blocks)


async def test_storing_the_board_is_retried_after_a_disk_error(
    port_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(board_check, "STORE_RETRY_S", 0.05)
    memory, event = KnownBoardFile(tmp_path / "gone", "house"), "the board cannot be stored"
    memory.path.parent.touch()  # a file where the folder should be
    with capture_logs() as logs:
        async with source(port_folder / "ttyUSB0", memory) as reader, board(port_folder / "ttyUSB0"):
            await until(lambda: [line for line in logs if event in line["event"]])
            blocks_before = len(reader.blocks)
            await until(lambda: len(reader.blocks) > blocks_before + 3)
            memory.path.parent.unlink()
            await wait_until_stored(memory, "00000001")
    assert len([line for line in logs if event in line["event"]]) == 1
    assert stat.S_IMODE(memory.path.parent.stat().st_mode) == 0o700


async def test_deleted_folder_of_the_board_file_is_recreated(
    port_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(board_check, "STORE_RETRY_S", 0.05)
    memory = KnownBoardFile(tmp_path / "state", "house")
    async with source(port_folder / "ttyUSB0", memory), board(port_folder / "ttyUSB0"):
        await wait_until_stored(memory, "00000001")
        shutil.rmtree(memory.path.parent)
        await wait_until_stored(memory, "00000001")


async def test_board_file_that_was_reset_by_accept_is_not_overwritten(
    port_folder: Path, memory: KnownBoardFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(board_check, "STORE_RETRY_S", 0.0)
    async with source(port_folder / "ttyUSB0", memory) as reader, board(port_folder / "ttyUSB0"):
        await wait_until_stored(memory, "00000001")
        memory.save(NO_BOARD)
        blocks_before = len(reader.blocks)
        await until(lambda: len(reader.blocks) > blocks_before + 30)
        assert memory.load() == NO_BOARD


def test_board_file_is_private_and_follows_no_link(memory: KnownBoardFile) -> None:
    other_file = memory.path.with_name("other_file")
    other_file.write_text("theirs")
    memory.path.with_suffix(".new").symlink_to(other_file)
    memory.save(BOARD_42)
    assert memory.load() == BOARD_42
    assert stat.S_IMODE(memory.path.stat().st_mode) == 0o600
    assert other_file.read_text() == "theirs"
    link_file = KnownBoardFile(memory.path.parent, "link_file")
    link_file.path.symlink_to(memory.path)
    assert link_file.load() == {}


def test_pipe_in_place_of_the_board_file_is_ignored(memory: KnownBoardFile) -> None:
    os.mkfifo(memory.path)
    writer = os.open(memory.path, os.O_RDWR)
    try:
        assert memory.load() == {}
    finally:
        os.close(writer)


@pytest.mark.parametrize(
    "text", ["", "[]", "{", "[" * 4000, '{"serial": 1}', json.dumps({"serial": "x" * 3000}), "\xff", "null"]
)
def test_damaged_board_file_is_ignored_and_logged(memory: KnownBoardFile, text: str) -> None:
    memory.path.write_text(text, encoding="latin-1")
    with capture_logs() as logs:
        assert memory.load() == {}
    assert [line["file"] for line in logs] == [str(memory.path)]


def test_configured_serial_number_must_have_the_format_of_the_board_command() -> None:
    assert SensorSettings(serial="0000002a").serial == "0000002a"
    for invalid in ("42", "0000002A", 42):
        with pytest.raises(ValidationError):
            SensorSettings.model_validate({"serial": invalid})
    with pytest.raises(ValidationError, match="only a binary board reports its serial number"):
        SensorSettings(serial="0000002a", protocol="text")


def test_accept_is_rejected_if_the_settings_contain_the_serial_number(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pack = tmp_path / "pack.toml"
    pack.write_text('[sensor]\nserial = "0000002a"\n')
    err = error(run(capsys, "board", "--accept", pack))
    assert "sensor.serial = 0000002a: the settings name the board; change sensor.serial instead of --accept" in err


def test_accept_uses_the_given_folder_and_requires_a_stored_board(
    tmp_path: Path, memory: KnownBoardFile, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "mine"))
    pack = tmp_path / "pack.toml"
    pack.write_text('[pack]\nname = "house"\n')
    memory.save(BOARD_42)
    err = error(run(capsys, "board", "--accept", pack))
    assert f"{tmp_path / 'mine'}/bms-estimator/house.board.json: no board is stored in this file" in err
    assert run(capsys, "board", "--folder", memory.path.parent, "--accept", pack)[0] == 0
    assert memory.load() == NO_BOARD
    assert "requires --accept" in error(run(capsys, "board", "--folder", tmp_path))


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a file to another user")
def test_file_written_by_root_belongs_to_the_owner_of_the_folder(tmp_path: Path) -> None:
    folder, owner, group = tmp_path / "folder", 65534, 65533
    folder.mkdir(mode=0o700)
    os.chown(folder, owner, group)
    memory = KnownBoardFile(folder, "house")
    memory.save(NO_BOARD)
    file_status = memory.path.stat()
    assert (file_status.st_uid, file_status.st_gid, stat.S_IMODE(file_status.st_mode)) == (owner, group, 0o600)
