"""Serial source: ports that are missing, lost or fail, reported messages, commands, and the sample rate of a board."""

import asyncio
import contextlib
import errno
import os
import subprocess
import sys
import termios
import threading
from collections.abc import AsyncIterator, Coroutine
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import serial
from serial.tools import list_ports

from bms_estimator.model.arrays import SampleBlock
from bms_estimator.model.errors import UserError
from bms_estimator.protocols.base.relay import Relay
from bms_estimator.protocols.firmware.messages import ResetCause
from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.simulation.virtual_adc import Reading
from bms_estimator.simulation.virtual_board import VirtualBoard
from bms_estimator.sources.serial import port_list
from bms_estimator.sources.serial.device_detection import probe
from bms_estimator.sources.serial.serial_source import SerialSource
from tests.patience import LONG_S, until
from tests.serial_line import Line

STEADY = Reading(current_a=0.5, voltage_v=22.2, temperature_c=25.0)


def text_source(line: Line, **options: Any) -> SerialSource:
    """Return a source that reads text from the line, with short retry and silence intervals."""
    settings = {"port": str(line.path), "protocol": "text", "baud": 115_200} | options.pop("settings", {})
    return SerialSource(SensorSettings(**settings), first_retry_s=0.05, silent_s=0.3, **options)


async def take(source: SerialSource, min_samples: int) -> SampleBlock:
    """Return the next samples, at least ``min_samples``."""
    blocks: list[SampleBlock] = []
    async with asyncio.timeout(LONG_S):
        async for block, *_ in source:
            blocks.append(block.copy())
            if sum(b.size for b in blocks) >= min_samples:
                break
    return np.concatenate(blocks)


async def drain(source: SerialSource) -> None:
    async for _ in source:
        pass


@contextlib.asynccontextmanager
async def run_tasks(*tasks: Coroutine[Any, Any, None]) -> AsyncIterator[None]:
    """Run the coroutines during the test."""
    running = [asyncio.create_task(task) for task in tasks]
    try:
        yield
    finally:
        for task in running:
            task.cancel()
        await asyncio.gather(*running, return_exceptions=True)


async def store_blocks(source: SerialSource, blocks: list[SampleBlock]) -> None:
    """Append all blocks of the source to ``blocks``."""
    async for block, *_ in source:
        blocks.append(block.copy())


def sample_count(blocks: list[SampleBlock]) -> int:
    return sum(block.size for block in blocks)


async def test_missing_port_is_reported_and_retried(line: Line) -> None:
    async with text_source(line) as source:
        await until(lambda: source.silence_reason and "does not exist" in source.silence_reason)
        assert str(line.path) in (source.silence_reason or "")
        line.plug()
        await until(lambda: source.silence_reason and "no frame yet" in source.silence_reason)
        line.write(b"3.80,0.10\r\n3.81,0.20\r\n")
        samples = await take(source, 2)
        assert source.silence_reason is None
    assert samples["voltage_v"].tolist() == [3.80, 3.81]
    assert source.counters["reconnects"] == 0


async def test_board_that_is_unplugged_and_plugged_in_again_is_read_again(line: Line) -> None:
    line.plug()
    async with text_source(line) as source:
        await until(lambda: source.silence_reason and "no frame yet" in source.silence_reason)
        line.write(b"3.80,0.10\n")
        await take(source, 1)
        line.unplug()
        await until(lambda: source.silence_reason is not None)
        line.plug()
        await until(lambda: source.silence_reason and "no frame yet" in source.silence_reason)
        line.write(b"3.70,0.10\n")
        samples = await take(source, 1)
    assert samples["voltage_v"].tolist() == [3.70]
    assert source.counters["reconnects"] == 1


async def test_process_that_holds_the_port_is_reported_and_searched_for_in_a_thread(
    line: Line, monkeypatch: pytest.MonkeyPatch
) -> None:
    threads, original_holder = set[threading.Thread](), port_list.holder

    def holder(port: str) -> str | None:
        threads.add(threading.current_thread())
        return original_holder(port)

    monkeypatch.setattr(port_list, "holder", holder)
    line.plug()
    script = (
        "import serial,sys; s = serial.Serial(sys.argv[1], exclusive=True); print('open', flush=True); sys.stdin.read()"
    )
    other = subprocess.Popen(  # noqa: ASYNC220 - started at once
        [sys.executable, "-c", script, str(line.path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    try:
        assert other.stdout
        await asyncio.to_thread(other.stdout.readline)
        async with text_source(line) as source:
            await until(lambda: source.silence_reason and f"(pid {other.pid})" in source.silence_reason)
            assert threads
            assert threading.current_thread() not in threads
            other.communicate()  # ends the process
            await until(lambda: source.silence_reason and "no frame yet" in source.silence_reason)
    finally:
        other.communicate()


@pytest.mark.parametrize(
    ("owner", "function", "error"),
    [
        (termios, "tcsetattr", termios.error(errno.EIO, "Input/output error")),
        (termios, "tcflush", termios.error(errno.EIO, "Input/output error")),
        (serial.Serial, "_update_dtr_state", OSError(errno.EIO, "Input/output error")),
        (serial.Serial, "_reconfigure_port", ValueError("Failed to set custom baud rate")),
        (os, "open", OSError(errno.ENODEV, "No such device")),
    ],
)
async def test_port_that_fails_while_it_is_opened_is_reported_and_retried(
    line: Line, owner: object, function: str, error: Exception
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    line.plug()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(owner, function, fail)
        async with text_source(line) as source:
            await until(lambda: source.silence_reason and f"{line.path}: cannot be opened" in source.silence_reason)
            silence_reason, probe_result = source.silence_reason, probe(str(line.path))
            patch.undo()
            await until(lambda: source.silence_reason and "no frame yet" in source.silence_reason)
    assert str(error.args[-1]) in (silence_reason or "")
    assert probe_result.startswith("cannot be opened")


async def test_folder_of_ports_that_vanishes_while_it_is_listed_raises_no_error(tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(port_list, "BY_ID", tmp_path / "by-id")
        patch.setattr(Path, "is_dir", lambda _: True)  # as if the folder vanished after this check
        patch.setattr(list_ports, "comports", list)
        async with SerialSource(SensorSettings(port="auto")) as source:
            await until(lambda: source.silence_reason == "waiting for auto: no USB serial port is connected")


async def test_silent_board_and_wrong_baud_rate_have_different_messages(line: Line) -> None:
    line.plug()
    async with text_source(line) as source:
        drain_task = asyncio.create_task(drain(source))
        await until(lambda: source.silence_reason and "silent" in source.silence_reason)
        async with asyncio.timeout(LONG_S):
            while "baud" not in (source.silence_reason or ""):
                line.write(bytes(range(128, 256)))  # no text, as at a wrong baud rate
                await asyncio.sleep(0.05)
        assert "at 115200 baud" in (source.silence_reason or "")
        assert "wrong baud rate" in (source.silence_reason or "")
        line.write(b"\n3.80,0.10\n")
        await until(lambda: source.silence_reason is None)
    await drain_task


async def test_current_sign_of_the_settings_is_applied(line: Line) -> None:
    line.plug()
    async with text_source(line, settings={"current_sign": "charge_positive"}) as source:
        await until(lambda: source.silence_reason and "no frame yet" in source.silence_reason)
        line.write(b"3.80,-0.25\n")
        samples = await take(source, 1)
    assert samples["current_a"].tolist() == [0.25]


async def test_tap_receives_all_bytes_with_arrival_times_by_the_wall_clock(line: Line) -> None:
    class Tap(list[tuple[float, bytes]]):
        def write(self, arrival_s: float, data: bytes) -> None:
            self.append((arrival_s, data))

    tap = Tap()
    line.plug()
    async with text_source(line, tap=tap, wall=lambda: 1e9, monotonic=lambda: 5.0) as source:
        await until(lambda: source.silence_reason and "no frame yet" in source.silence_reason)
        line.write(b"junk\n3.80,0.10\n")
        await take(source, 1)
    assert b"".join(data for _, data in tap) == b"junk\n3.80,0.10\n"
    assert {arrival_s for arrival_s, _ in tap} == {1e9}


async def test_command_to_a_board_that_prints_text_is_rejected(line: Line) -> None:
    async with text_source(line) as source:
        with pytest.raises(UserError, match="takes no commands"):
            await source.store_current_zero()


async def test_samples_after_current_zero_are_decoded_with_the_new_zero_which_is_not_reported() -> None:
    blocks, reported = list[SampleBlock](), list[str]()
    with VirtualBoard(lambda _: STEADY) as virtual:
        async with (
            SerialSource(SensorSettings(port=virtual.path)) as source,
            run_tasks(virtual.run(), store_blocks(source, blocks)),
        ):
            source.board_check.on_recalibrated = reported.append
            await until(lambda: sample_count(blocks) >= 20 and source.board_check.serial)
            assert np.concatenate(blocks)["current_a"].mean() == pytest.approx(0.5, abs=0.03)
            await source.store_current_zero()
            blocks.clear()
            await until(lambda: sample_count(blocks) >= 20)
            assert np.concatenate(blocks)["current_a"].mean() == pytest.approx(0.0, abs=0.03)
    assert reported == []


async def test_relay_command_is_not_sent_to_a_board_that_was_reset_although_its_hello_was_damaged() -> None:
    high = Relay(high=True, high_when_silent=None)
    with VirtualBoard(lambda _: STEADY) as virtual:
        source = SerialSource(SensorSettings(port=virtual.path))
        async with source, run_tasks(virtual.run(), drain(source)):
            await until(lambda: source.board)
            await source.relay(high, source.boots)
            assert virtual.relay_high
            virtual.send(b"half a frame, which runs into the hello")
            virtual.reset()
            with pytest.raises(UserError, match="the board was reset"):
                await source.relay(high, 0)
            assert (source.boots, virtual.relay_high) == (1, False)
            with pytest.raises(UserError, match="the board was reset before the command was sent"):
                await source.relay(high, 0)


async def test_sample_rate_is_set_again_after_a_reset_whose_hello_was_damaged() -> None:
    blocks: list[SampleBlock] = []
    with VirtualBoard(lambda _: STEADY) as virtual:
        source = SerialSource(SensorSettings(port=virtual.path, sample_rate_hz=250))
        async with source, run_tasks(virtual.run(), store_blocks(source, blocks)):
            await until(lambda: source.board.get("sample_rate_hz") == "250" and sample_count(blocks) >= 200)
            virtual.send(b"half a frame, which runs into the hello")
            virtual.reset(ResetCause.BROWN_OUT)
            await until(lambda: source.counters["resets"] == 1)
            await until(lambda: source.board.get("sample_rate_hz") == "250")
            blocks.clear()
            await until(lambda: sample_count(blocks) >= 20)
    assert np.diff(np.concatenate(blocks)["time_s"]) == pytest.approx(1.0 / 250.0)
    assert source.counters["resets"] == 1


async def test_board_that_was_running_before_the_port_was_opened_gets_requests_for_hello_and_rate(
    tmp_path: Path,
) -> None:
    path, blocks = tmp_path / "board", list[SampleBlock]()
    source = SerialSource(SensorSettings(port=str(path), sample_rate_hz=50), first_retry_s=0.05)
    async with source, run_tasks(store_blocks(source, blocks)):
        for _ in range(2):
            with VirtualBoard(lambda _: STEADY) as virtual:
                async with run_tasks(virtual.run()):
                    await asyncio.sleep(0.1)  # the board sends its first hello before the port is opened
                    path.symlink_to(virtual.path)
                    expected = {"serial": "00000001", "sample_rate_hz": "50"}
                    await until(lambda expected=expected: source.board.items() >= expected.items())
                path.unlink()
