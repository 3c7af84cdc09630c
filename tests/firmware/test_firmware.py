"""Firmware in simavr, tested over its serial line."""

import itertools
import math
import subprocess
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bms_estimator.model.arrays import SampleStatus
from bms_estimator.protocols.firmware.frame_decoder import FrameDecoder
from bms_estimator.protocols.firmware.messages import (
    PROTOCOL_VERSION,
    AckResult,
    BoardStatus,
    Channels,
    MessageType,
    ResetCause,
    SampleMessage,
    command,
    hello_command,
    seal,
    set_bandgap_command,
    set_current_slope_command,
    set_divider_command,
    set_rate_command,
    set_ratiometric_command,
    set_serial_command,
    zero_current_command,
)
from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.simulation.virtual_adc import compute_aux_count, compute_window
from bms_estimator.sources.serial.serial_source import SerialSource
from tests.firmware.host import Host
from tests.simavr_board import FIRMWARE, SimavrBoard, write_readings

pytestmark = pytest.mark.usefixtures("firmware")

MAX_SPEED = math.inf
"""Simulation as fast as the computer allows."""
STEADY = [(0.0, 2.5, 22.2, 25.0)]
"""Constant readings: time [s], current [A], voltage [V], temperature [C]."""
DIVIDER = 6.1
"""Ratio of the pack's voltage to that at the ADC."""
BANDGAP_LSB = 1.1 / 5.0 * 1024
"""Conversion of the bandgap of 1.1 V with a reference of 5 V and 10 bits [LSB]."""
AUX_SETTLING = 3
"""Number of conversions of an auxiliary input that are discarded before those that count."""

Start = Callable[..., Host]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Return a function that starts a board with readings and options, and returns its host."""
    with ExitStack() as stack:

        def begin(readings: Sequence[tuple[float, ...]] = STEADY, speed: float = MAX_SPEED, **options: Any) -> Host:
            file = write_readings(tmp_path / "readings.csv", readings)
            board = stack.enter_context(SimavrBoard(file, speed=speed, **options))
            return stack.enter_context(Host(board.path))

        yield begin


def means(samples: list[SampleMessage]) -> tuple[float, float]:
    """Return the mean conversions of voltage and current [LSB]."""
    pairs = sum(s.count for s in samples)
    return sum(s.voltage_sum for s in samples) / pairs, sum(s.current_sum for s in samples) / pairs


def test_hello_precedes_the_first_sample_and_describes_the_board(start: Start) -> None:
    host = start()
    host.next_samples(1)
    samples_before, hello = host.hellos[0]
    assert samples_before == 0
    assert hello.reset_cause == ResetCause.POWER_ON
    assert (hello.serial, hello.sequence, hello.board_us) == (0, 0, 0)
    assert (hello.rate_hz, hello.period_ns, hello.adc_bits) == (100, 10_000_000, 10)
    assert hello.channels == Channels.NTC | Channels.CURRENT_RATIOMETRIC
    assert (hello.divider_ppm, hello.current_uv_per_a) == (6_100_000, 100_000)
    assert (hello.current_zero_ppm, hello.bandgap_uv) == (500_000, 1_100_000)
    assert (hello.ntc_series_ohm, hello.ntc_r25_ohm, hello.ntc_beta_k) == (10_000, 10_000, 3950)
    assert hello.bandgap_sum / hello.bandgap_count == pytest.approx(BANDGAP_LSB, abs=0.2)


@pytest.mark.parametrize("mcu", ["atmega2560", "atmega32u4", "atmega328"])
def test_compilation_for_another_chip_fails_with_the_reason(tmp_path: Path, mcu: str) -> None:
    target = tmp_path / "bms_board.ino.o"
    command = ["make", "--silent", "-C", FIRMWARE, f"MCU={mcu}", f"BUILD={tmp_path}", target]
    process = subprocess.run(command, capture_output=True, text=True, check=False)
    assert process.returncode != 0
    assert "This firmware is for an ATmega328P at 16 MHz" in process.stderr


def test_requested_hello_has_the_next_sequence_number(start: Start) -> None:
    host = start()
    host.next_samples(50)
    host.send(hello_command())
    hello = host.next_hello()
    samples_before, _ = host.hellos[-1]
    last_sample = host.samples[samples_before - 1]
    assert hello.sequence == last_sample.sequence + 1
    assert hello.board_us == last_sample.board_us


def test_sample_period_is_exactly_10_ms(start: Start) -> None:
    host = start()
    host.next_samples(1000)
    samples = host.samples[:1000]
    assert [s.sequence for s in samples] == list(range(1000))
    assert [s.board_us for s in samples] == [10_000 * (i + 1) for i in range(1000)]


@pytest.mark.parametrize(("rate_hz", "seconds"), [pytest.param(100, 20, marks=pytest.mark.thorough), (1000, 6)])
def test_board_clock_and_adc_trigger_do_not_drift_apart(start: Start, rate_hz: int, seconds: int) -> None:
    """A signal with a period of one second changes at the same conversion of each second only if no conversion is lost."""
    # 0.4 ms after the begin of a window, so that both levels are in it
    changes = [(0.5 * i + 0.0004, 0.0, 12.0 if i % 2 else 16.0, 25.0) for i in range(2 * seconds)]
    host = start([(0.0, 0.0, 12.0, 25.0), *changes], noise_lsb=0.0)
    host.send_command(set_rate_command(rate_hz))
    host.next_samples(rate_hz)
    samples = host.next_samples(rate_hz * (seconds - 3))
    seconds_of_sums = np.array([[s.voltage_sum, s.count] for s in samples]).reshape(-1, rate_hz, 2)
    assert (seconds_of_sums == seconds_of_sums[0]).all()
    voltage_sums, counts = seconds_of_sums[0].T
    assert len(np.unique(voltage_sums / counts)) >= 3, "no window contains a change of the signal"


@pytest.mark.parametrize("rate_hz", [1, 7, 10, 300, 999, 1000])
def test_each_rate_has_its_exact_period_after_the_next_samples(start: Start, rate_hz: int) -> None:
    host = start()
    pairs, period_ns = compute_window(rate_hz)
    ack = host.send_command(set_rate_command(rate_hz))
    assert (ack.command, ack.result, ack.value) == (MessageType.COMMAND_SET_RATE, AckResult.OK, period_ns)
    host.next_samples(2)  # the current window, and one that may have ended before the command
    samples = host.next_samples(min(2 * rate_hz, 1500) + 1)
    assert [s.sequence for s in samples] == list(range(samples[0].sequence, samples[0].sequence + len(samples)))
    # each window has the same number of conversions: pairs of voltage and current, and those of an auxiliary input
    assert all(2 * s.count + bool(s.aux_count) * (AUX_SETTLING + s.aux_count) == 2 * pairs for s in samples)
    since_us = np.array([s.board_us for s in samples]) - samples[0].board_us
    assert np.abs(since_us - np.arange(len(samples)) * period_ns * 1e-3).max() <= 1.0
    assert not any(s.status & BoardStatus.OVERRUN for s in samples)
    aux = [s for s in samples if s.aux_count]
    assert {s.aux_count for s in aux} == {compute_aux_count(rate_hz)}
    # above 100 Hz, not each window has auxiliary readings; NTC and bandgap take turns
    assert len(aux) == pytest.approx(len(samples) / max(rate_hz // 100, 1), abs=1)
    assert all((a.status ^ b.status) & BoardStatus.AUX_IS_NTC for a, b in itertools.pairwise(aux))


@pytest.mark.parametrize("rate_hz", [pytest.param(1, marks=pytest.mark.thorough), 10])
def test_reference_has_low_noise_at_low_rates(start: Start, rate_hz: int) -> None:
    """The reference is averaged over seconds. At low rates these have few samples, each with many readings of the bandgap."""
    host, decoder = start(), FrameDecoder()
    host.send_command(set_rate_command(rate_hz))
    decoder.feed(0.0, host.hellos[0][1].encode())
    references_v = []
    for sample in host.next_samples(40):
        decoder.feed(0.0, sample.encode())
        references_v.append(decoder.reference_v)
    assert np.std(references_v) < 2e-4 * 5.0


@pytest.mark.parametrize("rate_hz", [0, 1001, 65535])
def test_rate_out_of_range_is_rejected(start: Start, rate_hz: int) -> None:
    host = start()
    ack = host.send_command(command(MessageType.COMMAND_SET_RATE, rate_hz.to_bytes(2, "little")))
    assert (ack.result, ack.value) == (AckResult.BAD_VALUE, 10_000_000)  # still the period of 100 Hz [ns]


@pytest.mark.parametrize("avcc_mv", [5000, 4750])
def test_readings_are_measured_within_the_resolution_of_the_adc_at_any_supply(start: Start, avcc_mv: int) -> None:
    readings = [(0.0, 0.0), (-20.0, 3.0), (20.0, 23.0), (1.234, 22.2), (0.01, 12.345)]
    host = start([(0.5 * i, *reading, 25.0) for i, reading in enumerate(readings)], avcc_mv=avcc_mv)
    host.next_samples(len(readings) * 50)
    decoder = FrameDecoder()
    block = decoder.feed(0.0, b"".join([host.hellos[0][1].encode(), *(s.encode() for s in host.samples)]))
    assert decoder.reference_v == pytest.approx(avcc_mv * 1e-3, rel=3e-4)
    lsb_v = decoder.reference_v / 1024
    for i, (current_a, voltage_v) in enumerate(readings):
        part = block[50 * i + 10 : 50 * i + 40]  # the samples at the changes of the readings are not compared
        for name, truth, lsb in (("voltage_v", voltage_v, DIVIDER * lsb_v), ("current_a", current_a, 50.0 / 1024)):
            if name == "voltage_v" and truth == 0.0:
                continue  # the ADC clips noise below zero, so that the mean is too high
            assert np.abs(part[name] - truth).max() < 1.0 * lsb
            assert abs(part[name].mean() - truth) < 0.2 * lsb + 3e-4 * abs(truth)


@pytest.mark.parametrize(
    ("current_a", "voltage_v", "bits"),
    [
        (0.0, 31.0, SampleStatus.VOLTAGE_SATURATED),
        (26.0, 12.0, SampleStatus.CURRENT_SATURATED),
        (-26.0, 12.0, SampleStatus.CURRENT_SATURATED),
        (24.0, 30.0, 0),
    ],
)
def test_readings_outside_the_range_of_the_adc_are_marked_as_saturated(
    start: Start, current_a: float, voltage_v: float, bits: int
) -> None:
    saturated = BoardStatus.VOLTAGE_SATURATED | BoardStatus.CURRENT_SATURATED
    assert {s.status & saturated for s in start([(0.0, current_a, voltage_v, 25.0)]).next_samples(20)} == {bits}


def test_temperature_of_the_ntc_is_measured(start: Start) -> None:
    decoder = FrameDecoder()
    temperatures_c = [-20.0, 25.0, 60.0]
    host = start([(4.0 * i, 0.0, 22.2, celsius) for i, celsius in enumerate(temperatures_c)])
    host.next_samples(1200)
    block = decoder.feed(0.0, b"".join([host.hellos[0][1].encode(), *(s.encode() for s in host.samples)]))
    # each temperature lasts 400 samples; the last ones follow the change
    assert block["temperature_c"][[380, 780, 1180]] == pytest.approx(temperatures_c, abs=0.3)


def test_board_without_an_ntc_reads_only_the_bandgap(start: Start) -> None:
    host = start([(0.0, 0.0, 22.2)])
    samples = host.next_samples(20)
    assert not host.hellos[0][1].channels & Channels.NTC
    assert all(s.aux_count == 1 and not s.status & BoardStatus.AUX_IS_NTC for s in samples)
    assert np.mean([s.aux_sum for s in samples]) == pytest.approx(BANDGAP_LSB, abs=1.0)


def test_restart_counts_as_a_watchdog_reset_and_keeps_the_settings_in_the_eeprom(start: Start) -> None:
    host = start([(0.0, 0.8, 22.2, 25.0)])
    first = host.hellos[0][1]
    zero = host.send_command(zero_current_command())
    assert (zero.command, zero.result) == (MessageType.COMMAND_ZERO_CURRENT, AckResult.OK)
    assert zero.value == pytest.approx(516_000, abs=30)  # 0.5 + 0.8 A x 0.1 V/A / 5 V
    assert host.send_command(set_serial_command(0xC0FFEE)).value == 0xC0FFEE
    assert host.send_command(set_bandgap_command(1.085)).value == 1_085_000
    assert host.send_command(set_divider_command(5.0123)).value == 5_012_300
    assert host.send_command(set_current_slope_command(0.025)).value == 25_000
    assert host.send_command(set_ratiometric_command(0)).value == 0
    host.next_samples(20)  # 200 ms, because writing a byte of the EEPROM takes 3.4 ms
    assert host.send_command(command(MessageType.COMMAND_RESTART)).result == AckResult.OK
    host.until(lambda: len(host.hellos) == 2)
    samples_before, hello = host.hellos[1]
    assert hello.reset_cause == ResetCause.WATCHDOG
    assert hello.boot_id != first.boot_id
    assert (hello.sequence, hello.board_us, hello.rate_hz) == (0, 0, 100)
    assert (hello.serial, hello.bandgap_uv, hello.current_zero_ppm) == (0xC0FFEE, 1_085_000, zero.value)
    assert (hello.divider_ppm, hello.current_uv_per_a, hello.channels) == (5_012_300, 25_000, Channels.NTC)
    host.next_samples(1)
    sample = host.samples[samples_before]
    assert sample.sequence == 0
    assert sample.status >> 4 == ResetCause.WATCHDOG  # the upper half of the status


def test_sample_times_increase_across_a_restart(start: Start) -> None:
    host = start()
    host.next_samples(100)
    host.send_command(command(MessageType.COMMAND_RESTART))
    host.until(lambda: len(host.hellos) == 2)
    host.next_samples(100)
    decoder, (samples_before_restart, hello) = FrameDecoder(), host.hellos[-1]
    decoder.feed(0.0, host.hellos[0][1].encode())
    before = decoder.feed(1.0, b"".join(s.encode() for s in host.samples[:samples_before_restart]))
    after = decoder.feed(1.5, hello.encode() + b"".join(s.encode() for s in host.samples[samples_before_restart:]))
    assert decoder.counters.resets == 1
    assert decoder.counters.frames_lost == 0
    assert after["status"][0] & SampleStatus.RESET
    assert after["time_s"][0] > before["time_s"][-1]


def test_current_zero_far_from_mid_scale_is_rejected(start: Start) -> None:
    host = start([(0.0, 8.0, 22.2, 25.0)])
    ack = host.send_command(zero_current_command())
    assert (ack.result, ack.value) == (AckResult.BAD_VALUE, 500_000)  # still the middle of the range [ppm]


def test_second_zero_command_is_rejected_while_the_first_is_in_progress(start: Start) -> None:
    host = start()
    assert host.send_command(zero_current_command() * 2).result == AckResult.BUSY
    host.until(lambda: len(host.acks) == 2)
    assert host.acks[1].result == AckResult.OK


@pytest.mark.parametrize(
    ("set_command", "old_value"),
    [
        (set_bandgap_command(1.3), 1_100_000),
        (set_divider_command(0.99), 6_100_000),
        (set_divider_command(101.0), 6_100_000),
        (set_current_slope_command(0.0009), 100_000),
        (set_current_slope_command(2.1), 100_000),
        (set_ratiometric_command(2), 1),
    ],
)
def test_implausible_value_is_rejected(start: Start, set_command: bytes, old_value: int) -> None:
    ack = start().send_command(set_command)
    assert (ack.result, ack.value) == (AckResult.BAD_VALUE, old_value)


@pytest.mark.parametrize("rates_hz", [(801, 1000), (667, 999), pytest.param((1, 900), marks=pytest.mark.thorough)])
def test_increase_of_the_rate_misses_no_timer_compare(start: Start, rates_hz: tuple[int, int]) -> None:
    """The simulator aborts at a missed compare, which would cost the chip 4 ms that its clock does not count."""
    host = start()
    for i in range(10):
        for rate_hz in rates_hz:
            assert host.send_command(set_rate_command(rate_hz)).result == AckResult.OK
            host.next_samples(2 + i % 3)


def test_restart_does_not_depend_on_the_boot_loader(start: Start) -> None:
    """The simulator aborts at a real watchdog reset, because the old boot loader of a Nano would hang in it."""
    host = start()
    for restarts in range(1, 4):
        host.next_samples(30)
        host.send_command(set_rate_command(1000))
        host.send_command(command(MessageType.COMMAND_RESTART))
        host.until(lambda count=restarts: len(host.hellos) > count)
        assert host.hellos[-1][1].reset_cause == ResetCause.WATCHDOG
        samples = host.next_samples(20)
        assert [s.sequence for s in samples[-10:]] == list(range(samples[-10].sequence, samples[-10].sequence + 10))
    assert len({hello.boot_id for _, hello in host.hellos}) == 4


def test_garbage_is_ignored_and_the_next_command_is_executed(start: Start) -> None:
    host = start()
    valid = set_serial_command(7)
    wrong_crc = seal(b"\x01\x14\x09\0\0\0")[:-2] + b"\x01\0"
    noise = np.random.default_rng(1).integers(0, 256, 3000, dtype=np.uint8).tobytes()
    for junk in (wrong_crc, b"\0\0\0", b"\xff" * 500 + b"\0", valid[:4] + b"\0", noise + b"\0"):
        host.send(junk)
        host.next_samples(20)
    assert host.acks == []
    assert host.send_command(valid).value == 7
    assert host.invalid_frames == []


def test_commands_of_other_versions_and_unknown_commands_are_rejected_with_the_reason(start: Start) -> None:
    host = start()
    other = host.send_command(seal(bytes((PROTOCOL_VERSION + 1, MessageType.COMMAND_SET_RATE, 1, 0))))
    assert (other.result, other.value) == (AckResult.OTHER_VERSION, PROTOCOL_VERSION)
    assert host.send_command(seal(bytes((PROTOCOL_VERSION, 0x7F)))).result == AckResult.UNKNOWN_COMMAND
    truncated = command(MessageType.COMMAND_SET_SERIAL, b"\x01")
    assert host.send_command(truncated).result == AckResult.UNKNOWN_COMMAND


def test_overrun_of_the_line_loses_samples_but_their_times_remain_correct(start: Start) -> None:
    host = start(speed=1.0)
    host.send_command(set_rate_command(1000))
    host.send(hello_command() * 400)
    host.until(lambda: any(s.status & BoardStatus.OVERRUN for s in host.samples))
    host.next_samples(500)
    steps = [(after.sequence - before.sequence, after) for before, after in itertools.pairwise(host.samples)]
    lost = sum(step - 1 for step, _ in steps)
    assert lost > 0
    assert all((step > 1) == bool(sample.status & BoardStatus.OVERRUN) for step, sample in steps)
    # each hello between two samples has a sequence number between theirs
    hellos = [(n, hello.sequence) for n, hello in host.hellos if 0 < n < len(host.samples)]
    assert len(hellos) > 10
    assert all(host.samples[n - 1].sequence < sequence <= host.samples[n].sequence for n, sequence in hellos)
    first, last = host.samples[-400], host.samples[-1]
    assert last.board_us - first.board_us == 1000 * (last.sequence - first.sequence)
    assert host.invalid_frames == []


async def test_serial_source_sets_the_rate_and_reads_the_samples(tmp_path: Path) -> None:
    readings = write_readings(tmp_path / "readings.csv", STEADY)
    with SimavrBoard(readings) as simulated:
        settings = SensorSettings(port=simulated.path, sample_rate_hz=250)
        async with SerialSource(settings, first_retry_s=0.05) as board:
            async for block, *_ in board:
                assert block["voltage_v"] == pytest.approx(22.2, abs=0.03)
                assert block["current_a"] == pytest.approx(2.5, abs=0.06)
                if len(block) and board.board.get("sample_rate_hz") == "250":
                    break
            assert board.counters["frames_lost"] == 0
            assert board.counters["crc_errors"] == 0
            assert board.silence_reason is None
