"""Virtual board in Python: its frames contain the simulated readings, and the decoder counts its faults."""

import asyncio
import contextlib
import math
import os
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from bms_estimator.model.arrays import SampleBlock, SampleStatus
from bms_estimator.protocols.base.relay import Relay
from bms_estimator.protocols.firmware.frame_decoder import FrameCounters, FrameDecoder
from bms_estimator.protocols.firmware.messages import (
    AckResult,
    Channels,
    MessageType,
    ResetCause,
    command,
    hello_command,
    set_bandgap_command,
    set_current_slope_command,
    set_divider_command,
    set_rate_command,
    set_ratiometric_command,
    set_relay_command,
    set_serial_command,
    unseal,
    zero_current_command,
)
from bms_estimator.protocols.firmware.protocol import BoardProtocol
from bms_estimator.protocols.registry import make_protocol
from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.simulation.virtual_adc import BoardParts, Reading, compute_window
from bms_estimator.simulation.virtual_board import BoardFault, VirtualBoard
from tests.patience import LONG_S, until

STEADY = Reading(current_a=2.5, voltage_v=22.2, temperature_c=25.0)
DIVIDER = 6.1
VOLTS_PER_AMPERE = 0.1
PERIOD_S = compute_window(100)[1] * 1e-9
"""Sample period of a board at 100 Hz, the default rate [s]."""
END_MARK = b"and that is all"
"""Bytes that a board sends at the end of a test."""

Event = Callable[[VirtualBoard], None]


async def receive(board: VirtualBoard, samples: int, events: dict[int, Event] | None = None) -> bytes:
    """Run a board for ``samples`` samples. Return the bytes that it sends.

    Args:
        board: A board at 100 Hz.
        samples: Number of samples.
        events: Actions on the board, by the number of samples before them.
    """
    data = bytearray()

    async def run() -> None:
        try:
            for count in sorted({*(events or {}), samples}):
                # The run ends half a period early, so that no further sample begins.
                await board.run((count - board.samples - 0.5) * PERIOD_S)
                if events and count in events:
                    events[count](board)
        finally:
            board.send(END_MARK)

    with board:
        host = os.open(board.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            async with asyncio.timeout(LONG_S):
                task = asyncio.create_task(run())
                while not data.endswith(END_MARK):
                    await asyncio.sleep(0.005)
                    with contextlib.suppress(BlockingIOError):
                        data += os.read(host, 1 << 16)
                await task
        finally:
            os.close(host)
    return bytes(data.removesuffix(END_MARK))


def make_board(reading: Reading = STEADY, **options: Any) -> VirtualBoard:
    """Return a board that measures a constant reading as fast as possible."""
    return VirtualBoard(lambda _: reading, speed=math.inf, **options)


def decode(data: bytes) -> tuple[SampleBlock, FrameCounters]:
    """Decode frames. Return their samples and the counters of the decoder."""
    decoder = FrameDecoder()
    return decoder.feed(0.0, data), decoder.counters


async def test_frames_contain_the_readings_within_the_resolution_of_the_adc() -> None:
    block, counters = decode(await receive(make_board(), samples=500))
    assert block.size == 500
    assert np.allclose(np.diff(block["time_s"]), 0.01, rtol=0.0, atol=1e-9)
    step_v = 5.0 / 1024  # 5 V on a 10-bit converter
    assert np.abs(block["voltage_v"] - STEADY.voltage_v).max() < DIVIDER * step_v
    assert np.abs(block["current_a"] - STEADY.current_a).max() < step_v / VOLTS_PER_AMPERE
    assert block["voltage_v"].mean() == pytest.approx(STEADY.voltage_v, abs=0.2 * DIVIDER * step_v)
    assert block["temperature_c"][-1] == pytest.approx(STEADY.temperature_c, abs=0.3)
    assert counters == FrameCounters(bytes_received=counters.bytes_received, frames_received=500)


async def test_an_ntc_with_a_loose_contact_reads_its_temperature_or_nothing() -> None:
    board = VirtualBoard(lambda s: Reading(0.0, 22.2, 80.0 if s % 2.6 < 1.3 else math.nan), speed=math.inf)
    block, _ = decode(await receive(board, 1500))
    measured_c = block["temperature_c"][np.isfinite(block["temperature_c"])]
    assert 0.4 < measured_c.size / block.size < 0.6
    assert measured_c == pytest.approx(80.0, abs=1.0)


async def test_a_hot_ntc_that_fails_to_a_plausible_value_is_not_believed() -> None:
    board = VirtualBoard(lambda s: Reading(0.0, 22.2, 80.0 if s < 13.0 else -12.0), speed=math.inf)
    protocol = BoardProtocol()
    block = protocol.feed(0.0, await receive(board, 1600))
    assert block["temperature_c"][1200] == pytest.approx(80.0, abs=1.0)
    assert np.isnan(block["temperature_c"][1400:]).all()
    assert (block["status"][1400:] == SampleStatus.PROBE_FAULT).all()
    assert protocol.counters["implausible"] == 1


async def test_a_supply_other_than_5_v_does_not_change_the_measured_values() -> None:
    block, _ = decode(await receive(make_board(parts=BoardParts(supply_v=4.75)), 300))
    assert block["voltage_v"].mean() == pytest.approx(STEADY.voltage_v, rel=1e-3)
    assert block["current_a"].mean() == pytest.approx(STEADY.current_a, rel=2e-3)


async def test_the_supply_does_not_change_the_current_of_a_sensor_that_is_not_ratiometric() -> None:
    parts = BoardParts(supply_v=4.75, volts_per_ampere=0.09, ratiometric=False)
    block, _ = decode(await receive(make_board(parts=parts), 300))
    assert block["current_a"].mean() == pytest.approx(STEADY.current_a, rel=2e-3)


async def test_equal_seeds_give_equal_bytes() -> None:
    assert await receive(make_board(seed=3), 50) == await receive(make_board(seed=3), 50)
    assert await receive(make_board(seed=3), 50) != await receive(make_board(seed=4), 50)


@pytest.mark.parametrize(
    ("reading", "status"),
    [
        # The ranges are 30.5 V (5 V times the divider) and 25 A (2.5 V on each side of the zero).
        (Reading(current_a=0.0, voltage_v=30.6, temperature_c=25.0), SampleStatus.VOLTAGE_SATURATED),
        (Reading(current_a=26.0, voltage_v=12.0, temperature_c=25.0), SampleStatus.CURRENT_SATURATED),
        (Reading(current_a=-26.0, voltage_v=12.0, temperature_c=25.0), SampleStatus.CURRENT_SATURATED),
    ],
)
async def test_samples_beyond_the_range_of_the_converter_are_marked_as_saturated(
    reading: Reading, status: SampleStatus
) -> None:
    block, _ = decode(await receive(make_board(reading), 10))
    assert (block["status"] == status).all()


@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        (BoardFault.DROP, {"frames_received": 57, "frames_lost": 3}),
        (BoardFault.CORRUPT, {"frames_received": 57, "frames_lost": 3}),
        (BoardFault.TRUNCATE, {"frames_received": 57, "frames_lost": 3}),
        (BoardFault.DUPLICATE, {"frames_received": 60, "duplicates": 3}),
        (BoardFault.NEWER_VERSION, {"frames_received": 57, "frames_lost": 3, "version_errors": 3}),
        (BoardFault.GARBAGE, {"frames_received": 60, "frames_lost": 0}),
    ],
)
async def test_the_decoder_counts_each_kind_of_fault_in_its_own_counters(
    fault: BoardFault, expected: dict[str, int]
) -> None:
    data = await receive(make_board(), 60, {20: lambda board: board.inject(fault, frames=3)})
    _, counters = decode(data)
    assert {name: getattr(counters, name) for name in expected} == expected
    damaged = counters.crc_errors + counters.cobs_errors + counters.length_errors
    assert (damaged >= 3) == (fault in {BoardFault.CORRUPT, BoardFault.TRUNCATE, BoardFault.GARBAGE})


async def test_a_sample_after_its_successor_counts_as_out_of_order_and_is_not_used() -> None:
    _, counters = decode(await receive(make_board(), 60, {20: lambda board: board.inject(BoardFault.SWAP)}))
    assert (counters.out_of_order + counters.duplicates, counters.frames_lost) == (1, 1)
    assert counters.frames_received == 59


async def test_the_first_sample_after_a_reset_is_marked_and_sample_times_keep_increasing() -> None:
    block, counters = decode(await receive(make_board(), 60, {30: lambda board: board.reset(ResetCause.EXTERNAL)}))
    assert (counters.frames_received, counters.resets, counters.frames_lost) == (60, 1, 0)
    assert list(np.flatnonzero(block["status"] & SampleStatus.RESET)) == [30]
    assert (np.diff(block["time_s"]) > 0.0).all()


async def test_wrap_of_the_board_clock_does_not_change_the_sample_times() -> None:
    # The clock of 32 bits wraps after 0.1 s, which is after ten of the samples.
    block, counters = decode(await receive(make_board(clock_us=2**32 - 100_000), 50))
    assert np.allclose(np.diff(block["time_s"]), 0.01, rtol=0.0, atol=1e-9)
    assert counters.resets == 0


async def test_commands_are_executed_and_acknowledged() -> None:
    virtual = VirtualBoard(lambda _: STEADY)
    decoder = FrameDecoder()
    with virtual:
        host = os.open(virtual.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        running = asyncio.create_task(virtual.run())

        async def ask(command: bytes) -> tuple[AckResult, int]:
            os.write(host, command)
            async with asyncio.timeout(LONG_S):
                while True:
                    with contextlib.suppress(BlockingIOError):
                        chunk = os.read(host, 1 << 16)
                        decoder.feed(0.0, chunk)
                    if acks := decoder.pop_acks():
                        return acks[0].result, acks[0].value
                    await asyncio.sleep(0.005)

        try:
            assert await ask(set_rate_command(250)) == (AckResult.OK, compute_window(250)[1])
            assert await ask(set_serial_command(77)) == (AckResult.OK, 77)
            # A rejected command is answered with the value that remains, in the units of the line (1e-6).
            assert await ask(set_bandgap_command(1.3)) == (AckResult.BAD_VALUE, 1_100_000)
            assert await ask(set_divider_command(5.0)) == (AckResult.OK, 5_000_000)
            assert await ask(set_divider_command(0.5)) == (AckResult.BAD_VALUE, 5_000_000)
            assert await ask(set_current_slope_command(0.025)) == (AckResult.OK, 25_000)
            assert await ask(set_ratiometric_command(0)) == (AckResult.OK, 0)
            result, zero_ppm = await ask(zero_current_command())
            assert result == AckResult.OK
            assert abs(zero_ppm - 550_000) < 100  # 0.5 + 2.5 A x 0.1 V/A / 5 V
            # The response to the second command also shows that the hello has arrived.
            os.write(host, b"\x05garbage\0")
            assert await ask(hello_command() + set_serial_command(78)) == (AckResult.OK, 78)
            assert decoder.hello is not None
            assert (decoder.hello.rate_hz, decoder.hello.serial) == (250, 77)
            assert (decoder.hello.divider_ppm, decoder.hello.current_uv_per_a) == (5_000_000, 25_000)
            assert decoder.hello.channels == Channels.NTC
            await ask(command(MessageType.COMMAND_RESTART))
            await ask(hello_command() + set_serial_command(79))
            assert decoder.hello.reset_cause == ResetCause.WATCHDOG
        finally:
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)
            os.close(host)


async def test_samples_lost_because_the_host_does_not_read_are_marked_as_overrun() -> None:
    # 2,000 frames are more than the buffer of the pseudo-terminal holds.
    virtual = VirtualBoard(lambda _: STEADY, rate_hz=1000, speed=50.0)
    with virtual:
        host = os.open(virtual.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        running = asyncio.create_task(virtual.run())
        await until(lambda: virtual.samples >= 2000)
        decoder = FrameDecoder()
        blocks = []
        try:
            async with asyncio.timeout(LONG_S):
                while decoder.counters.overruns == 0:
                    await asyncio.sleep(0.001)
                    with contextlib.suppress(BlockingIOError):
                        blocks.append(decoder.feed(0.0, os.read(host, 1 << 16)))
        finally:
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)
            os.close(host)
    block = np.concatenate(blocks)
    overrun = block["status"] & SampleStatus.OVERRUN != 0
    assert (overrun == (block["status"] & SampleStatus.GAP != 0)).all()
    assert decoder.counters.frames_lost > 0
    assert decoder.counters.crc_errors == 0


async def test_text_mode_prints_lines_of_the_text_protocol() -> None:
    data = await receive(make_board(mode="text"), 50)
    decoder = make_protocol(SensorSettings(port="x", protocol="text", baud=115_200))
    block = decoder.feed(0.0, data)
    assert block.size == 50
    assert block["voltage_v"] == pytest.approx(STEADY.voltage_v, abs=0.03)
    assert block["current_a"] == pytest.approx(STEADY.current_a, abs=0.06)
    assert block["temperature_c"] == pytest.approx(STEADY.temperature_c, abs=0.3)


async def test_board_takes_no_sample_before_a_host_opens_the_line() -> None:
    sampled = asyncio.Event()

    def measure(_: float) -> Reading:
        sampled.set()
        return STEADY

    with VirtualBoard(measure) as board:
        running = asyncio.create_task(board.run_for_host())
        await asyncio.sleep(0.05)
        assert not sampled.is_set()
        host = os.open(board.path, os.O_RDWR | os.O_NOCTTY)
        await asyncio.wait_for(sampled.wait(), LONG_S)
        running.cancel()
        os.close(host)


async def test_relay_changes_to_its_fallback_level_when_the_host_is_silent_and_to_low_at_a_reset() -> None:
    def set_relay(high: bool, high_when_silent: bool | None, silent_s: int = 0) -> Event:
        return lambda board: board._handle_command(unseal(set_relay_command(Relay(high, high_when_silent, silent_s))))

    levels: dict[int, bool] = {}

    def read_level(board: VirtualBoard) -> None:
        levels[board.samples] = board.relay_high

    # The keys are numbers of samples at 100 Hz. The commands at 30 and 250 end silences; their fallback levels apply after
    # 2 s (sample 230) and 1 s (sample 350).
    events: dict[int, Event] = {
        10: set_relay(high=True, high_when_silent=None),
        20: read_level,
        30: set_relay(high=True, high_when_silent=False, silent_s=2),
        200: read_level,
        240: read_level,
        250: set_relay(high=False, high_when_silent=True, silent_s=1),
        300: read_level,
        360: read_level,
        370: VirtualBoard.reset,
        380: read_level,
    }
    decoder = FrameDecoder()
    decoder.feed(0.0, b"\0" + await receive(make_board(), 400, events))
    assert levels == {20: True, 200: True, 240: False, 300: False, 360: True, 380: False}
    assert [ack.result for ack in decoder.pop_acks()] == [AckResult.OK] * 3


async def test_a_relay_command_with_a_fallback_but_no_time_is_rejected_and_changes_nothing() -> None:
    # A fallback level (bit 8) without the time after which it applies (upper half).
    invalid = command(MessageType.COMMAND_SET_RELAY, (1 << 8).to_bytes(4, "little"))
    board = make_board()
    decoder = FrameDecoder()
    decoder.feed(0.0, b"\0" + await receive(board, 20, {10: lambda board: board._handle_command(unseal(invalid))}))
    assert [(ack.result, ack.value) for ack in decoder.pop_acks()] == [(AckResult.BAD_VALUE, 0)]
    assert not board.relay_high
