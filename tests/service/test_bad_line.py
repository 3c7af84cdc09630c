"""Service whose serial line has faults: from bytes on a pseudo-terminal over decoder and estimator to published values."""

import asyncio
import itertools
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import Any

import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.model.cell import load_cell
from bms_estimator.model.payloads.health import Health
from bms_estimator.model.payloads.snapshot import Snapshot
from bms_estimator.protocols.firmware.messages import MODULUS, BoardStatus, Hello, ResetCause, SampleMessage
from bms_estimator.service.live_loop import run_estimation_loop
from bms_estimator.settings.pack import PackSettings, PublishSettings, Settings
from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.sources.serial.serial_source import SerialSource
from tests.patience import LONG_S, until
from tests.scripted_source import Collector
from tests.serial_line import Line

CELL = load_cell("chen_mora")
RATE_HZ = 100
PERIOD_US = 1_000_000 // RATE_HZ
PAIRS = 100
"""Number of conversions of voltage and of current in a sample."""
VOLTAGE_SUM = round(PAIRS * 3.8 / 5.0 / 5.0 * 1024)
"""Sum for 3.8 V, with a divider of 5, a reference of 5.0 V and 10 bits [LSB]."""
CURRENT_SUM = PAIRS * 512
"""Sum for 0 A, the middle of the range [LSB]."""
HELLO = Hello(
    firmware_major=1, firmware_minor=2, firmware_patch=3, reset_cause=ResetCause.POWER_ON, boot_id=7, serial=0xBEEF,
    sequence=0, board_us=0, rate_hz=RATE_HZ, period_ns=1000 * PERIOD_US, adc_bits=10, channels=0,
    divider_ppm=5_000_000, current_uv_per_a=100_000, current_zero_ppm=500_000,
    bandgap_uv=1_100_000, bandgap_sum=56_320, bandgap_count=250,  # a reference of 5.0 V
    ntc_series_ohm=10_000, ntc_r25_ohm=10_000, ntc_beta_k=3950,
)  # fmt: skip


def sample(
    sequence: int, *, board_us: int | None = None, voltage_sum: int = VOLTAGE_SUM, status: int = 0
) -> SampleMessage:
    """Return a sample of 100 pairs of conversions; unless changed, of 3.8 V and 0 A, and at its regular time."""
    at_us = (sequence + 1) * PERIOD_US if board_us is None else board_us
    return SampleMessage(
        sequence=sequence % MODULUS,
        board_us=at_us % MODULUS,
        voltage_sum=voltage_sum,
        current_sum=CURRENT_SUM,
        count=PAIRS,
        aux_sum=0,
        aux_count=0,
        status=status,
    )


def frames(first: int, count: int, **options: Any) -> bytes:
    """Return the frames of ``count`` samples with sequence numbers from ``first`` on."""
    return b"".join(sample(n, **options).encode() for n in range(first, first + count))


class SkippingClock:
    """Monotonic clock of the host that a test advances by ``skipped_s``."""

    def __init__(self) -> None:
        self.skipped_s = 0.0

    def __call__(self) -> float:
        return time.monotonic() + self.skipped_s


class Service:
    """Running service with the board's end of its line, its sink, its task and its clock."""

    def __init__(
        self, line: Line, sink: Collector, task: asyncio.Task[Estimator], stop: asyncio.Event, clock: SkippingClock
    ) -> None:
        self.line, self.sink, self.task, self._stop, self.clock = line, sink, task, stop, clock

    async def until(self, condition: Callable[[Snapshot], bool]) -> Snapshot:
        return await self.sink.until(condition)

    async def wait_for_frames(self, frames: int) -> None:
        """Wait until this number of valid frames was received."""
        await self.until(lambda s: s.health.line["frames_received"] >= frames)

    async def end(self) -> tuple[Estimator, Health]:
        """Stop the service. Return its estimator and its last health message."""
        self._stop.set()
        estimator = await asyncio.wait_for(self.task, LONG_S)
        return estimator, self.sink.snapshots[-1].health


@asynccontextmanager
async def service(
    line: Line, *, hello: bytes = HELLO.encode(), series: int = 1, **sensor: Any
) -> AsyncIterator[Service]:
    """Run a service of ``series`` cells, to which the board has sent ``hello``. ``sensor`` are settings of ``[sensor]``."""
    line.plug()
    settings = Settings(
        pack=PackSettings(initial_soc=0.5),
        sensor=SensorSettings(port=str(line.path), **sensor),
        publish=PublishSettings(rate_hz=10.0),
    )
    clock = SkippingClock()
    board = SerialSource(settings.sensor, first_retry_s=0.05, silent_s=0.3, monotonic=clock)
    sink, stop = Collector(), asyncio.Event()
    pack = CELL.pack(series, 1)
    task = asyncio.create_task(run_estimation_loop(settings, pack, source=board, sinks=[sink], stop=stop))
    await until(lambda: "no frame yet" in (board.silence_reason or ""))
    line.write(hello)
    try:
        yield Service(line, sink, task, stop, clock)
    finally:
        stop.set()
        await asyncio.wait_for(task, LONG_S)


async def test_samples_are_scaled_by_the_hello_and_info_has_its_serial_number(line: Line) -> None:
    async with service(line) as live:
        live.line.write(frames(0, 20))
        first_estimate = await live.until(lambda s: s.estimate is not None)
        first_info = await live.until(lambda s: bool(s.info.board))
    assert first_estimate.estimate
    assert first_estimate.estimate.voltage_v == pytest.approx(3.8, abs=1e-3)
    assert first_estimate.estimate.current_a == pytest.approx(0.0, abs=1e-6)
    assert first_estimate.health.sensor_message is None
    assert first_info.info.board["firmware"] == "1.2.3"
    assert first_info.info.board["serial"] == "0000beef"


async def test_a_frame_with_a_wrong_checksum_is_counted_and_dropped(line: Line) -> None:
    async with service(line) as live:
        damaged_frame = bytearray(sample(1).encode())
        damaged_frame[7] ^= 0x10  # any bit
        live.line.write(frames(0, 1) + bytes(damaged_frame) + frames(2, 8))
        await live.wait_for_frames(9)
        _, health = await live.end()
    assert health.line["crc_errors"] == 1
    assert health.line["frames_lost"] == 1
    assert live.sink.snapshots[-1].estimate is None or live.sink.snapshots[-1].estimate.crc_errors == 1


async def test_a_board_with_a_newer_protocol_is_reported(line: Line) -> None:
    async with service(line, hello=HELLO.encode(version=2)) as live:
        live.line.write(sample(0).encode(version=2))
        snapshot = await live.until(lambda s: "another version of the protocol" in (s.health.sensor_message or ""))
        _, health = await live.end()
    assert snapshot.estimate is None
    assert health.line["version_errors"] == 2


async def test_sequence_number_and_microseconds_may_wrap_around(line: Line) -> None:
    async with service(line) as live:
        start = MODULUS - 5
        at_us = MODULUS - 5 * PERIOD_US
        wrapping = (sample(start + n, board_us=at_us + n * PERIOD_US) for n in range(10))
        live.line.write(replace(HELLO, sequence=start, board_us=at_us - PERIOD_US, boot_id=8).encode())
        live.line.write(b"".join(message.encode() for message in wrapping))
        await live.wait_for_frames(10)
        estimator, health = await live.end()
    assert health.line["frames_lost"] == 0
    assert health.line["frames_received"] == 10
    assert estimator.state["gaps"][0] == 0
    assert estimator.state["time_steps_back"][0] == 0


async def test_ten_seconds_without_frames_are_one_gap_and_do_not_end_the_lock(line: Line) -> None:
    async with service(line) as live:
        live.line.write(frames(0, 50))
        await live.wait_for_frames(50)
        live.clock.skipped_s += 10.0
        live.line.write(frames(1050, 50))
        await live.wait_for_frames(100)
        estimator, health = await live.end()
    assert health.line["frames_lost"] == 1000
    assert health.samples["gaps"] == 1
    assert health.lock_losses == 0
    assert estimator.state["time_s"][0] == pytest.approx(10.99, abs=1e-3)


async def test_saturated_and_implausible_voltages_are_dropped_and_the_sensor_counts_as_offline(line: Line) -> None:
    async with service(line) as live:
        live.line.write(
            frames(0, 5) + frames(5, 5, status=BoardStatus.VOLTAGE_SATURATED) + frames(10, 5, voltage_sum=0)
        )
        stale = await live.until(lambda s: s.health.samples["samples"] == 5 and not s.health.sensor_online)
        _, health = await live.end()
    assert health.samples["dropped_saturated"] == 5
    assert health.samples["dropped_range"] == 5
    assert "outside the cell's range" in (stale.health.sensor_message or "")


async def test_a_wrong_baud_rate_reaches_the_published_health(line: Line) -> None:
    async with service(line, baud=9600) as live:
        snapshot = asyncio.create_task(live.until(lambda s: "wrong baud rate" in (s.health.sensor_message or "")))
        for n in itertools.count():
            live.line.write(bytes((17 * n + k) % 255 + 1 for k in range(64)))  # no delimiter of frames
            if (await asyncio.wait({snapshot}, timeout=0.02))[0]:
                break
    assert "9600 baud" in (snapshot.result().health.sensor_message or "")


@pytest.mark.parametrize(
    ("sent", "expected"),
    [
        (b"3800,0.1\n", "the last of them 3800 V, 0.1 A, where 1.5..4.5 V and up to 5 A are possible: are these millivolts?"),
        (b"V=3.8 I=250\n", "are these milliamperes?"),
        (b"0.2,3.8\n", "are the columns swapped?"),
        (b"1e9,0.1\n", "the last of them 1e+09 V, 0.1 A, where 1.5..4.5 V and up to 5 A are possible"),
    ],
)  # fmt: skip
async def test_values_out_of_range_are_reported_with_the_range_and_a_hint(
    line: Line, sent: bytes, expected: str
) -> None:
    async with service(line, hello=b"\n", protocol="text") as live:
        live.line.write(sent)
        snapshot = await live.until(lambda s: "outside the cell's range" in (s.health.sensor_message or ""))
    assert (snapshot.health.sensor_message or "").endswith(expected)


async def test_unexpected_text_of_a_board_is_quoted(line: Line) -> None:
    async with service(line, hello=b"\n", protocol="text") as live:
        live.line.write(b"Vbat=13.3V only\r\nmore\r\n")
        snapshot = await live.until(lambda s: "the first: 'Vbat=13.3V only'" in (s.health.sensor_message or ""))
    assert "baud rate" not in (snapshot.health.sensor_message or "")


async def test_the_state_names_the_lowest_and_highest_cell(line: Line) -> None:
    async with service(line, hello=b"\n", series=3, protocol="text") as live:
        live.line.write(b"V=11.4 I=0.1\n")
        without = await live.until(lambda s: s.estimate is not None)
        live.line.write(b"V=11.4 I=0.1 cells=3.81,3.79,3.80\n")
        snapshot = await live.until(lambda s: s.estimate is not None and s.estimate.cell_lowest_v is not None)
    assert without.estimate
    assert (without.estimate.cell_lowest_v, without.estimate.cell_highest_v) == (None, None)
    assert snapshot.estimate
    assert (snapshot.estimate.cell_lowest_v, snapshot.estimate.cell_highest_v) == (3.79, 3.81)


async def test_the_published_reason_for_dropped_samples_is_the_latest_one(line: Line) -> None:
    """The voltage is out of range at first. Then a hello with a slope of zero makes the current NaN."""
    async with service(line) as live:
        live.line.write(frames(0, 5, voltage_sum=16_000_000))
        await live.until(lambda s: "where 1.5..4.5 V" in (s.health.sensor_message or ""))
        live.line.write(replace(HELLO, boot_id=8, current_uv_per_a=0).encode() + frames(0, 5))
        snapshot = await live.until(lambda s: s.health.samples["dropped_not_finite"] == 5)
    message = snapshot.health.sensor_message or ""
    assert message.endswith("; the last of them has no current: is the sensor connected?")


async def test_implausible_temperatures_and_cell_voltages_are_not_published(line: Line) -> None:
    async with service(line, hello=b"\n", protocol="text") as live:
        live.line.write(b"V=3.8 I=0.1 T=1e308 cells=3.8,1e308\n")
        snapshot = await live.until(lambda s: s.estimate is not None)
        _, health = await live.end()
    assert snapshot.estimate is not None
    assert snapshot.estimate.temperature_c is None
    assert (snapshot.estimate.cell_lowest_v, snapshot.estimate.cell_highest_v) == (3.8, 3.8)
    assert (health.line["implausible"], health.line["implausible_cells"]) == (1, 1)
