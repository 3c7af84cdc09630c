"""Line sources: lines are decoded to samples and recorded, and the recording replays bit-identically."""

import asyncio
from collections.abc import AsyncGenerator, Sequence
from pathlib import Path

import numpy as np
import pytest
from structlog.testing import capture_logs

from bms_estimator.model.arrays import SAMPLE, SampleBlock
from bms_estimator.protocols.base.reading import CONNECTED, sample_json_line
from bms_estimator.settings.pack import Settings
from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.sources.captures.raw_capture import make_header
from bms_estimator.sources.captures.recorder import CaptureRecorder
from bms_estimator.sources.captures.replay import RawCapture
from bms_estimator.sources.fault_log import FaultLog
from bms_estimator.sources.source import LineProducer, LineSource, ReceivedSamples, SourceUnavailableError
from tests.patience import LONG_S

TEXT = SensorSettings(protocol="text")


class ScriptedProducer(LineProducer):
    """Producer that yields or raises the items of the next script at each start. After the last script it waits."""

    name = "a device"

    def __init__(self, *scripts: Sequence[bytes | Exception]) -> None:
        self._scripts = list(scripts)
        self.starts = 0

    async def iter_lines(self) -> AsyncGenerator[bytes, None]:
        self.starts += 1
        for item in self._scripts.pop(0) if self._scripts else ():
            if isinstance(item, Exception):
                raise item
            yield item
        if not self._scripts:
            await asyncio.Event().wait()


async def take_received(source: LineSource, min_samples: int) -> list[ReceivedSamples]:
    """Return the next samples as received, at least ``min_samples``."""
    taken: list[ReceivedSamples] = []
    async with asyncio.timeout(LONG_S):
        async for received in source:
            taken.append(received)
            if sum(each.samples.size for each in taken) >= min_samples:
                break
    return taken


async def take(source: LineSource, min_samples: int) -> SampleBlock:
    """Return the next samples, at least ``min_samples``."""
    return np.concatenate([received.samples for received in await take_received(source, min_samples)])


async def wait_for_message(source: LineSource, expected: str) -> None:
    """Wait until the source reports this message."""
    async with asyncio.timeout(LONG_S):
        while source.silence_reason != expected:  # noqa: ASYNC110 - it has no event for it
            await asyncio.sleep(0.001)


def lines(*voltages_v: float) -> list[bytes]:
    """Return the lines of a producer after it has connected: one for each voltage, with a current of -2 A."""
    samples = [sample_json_line(v, -2.0, temperatures_c=[21.5], cells_v=[v / 16, None]) for v in voltages_v]
    return [CONNECTED, *samples]


async def test_lost_source_is_reopened_and_the_loss_is_logged_and_counted():
    alternating = [[SourceUnavailableError("no answer")], [OSError(113, "No route to host")]] * 2
    scripts = *alternating, [*lines(52.1), OSError(5, "Input/output error")], lines(52.2)
    source = LineSource(ScriptedProducer(*scripts), TEXT, first_retry_s=0.001)
    with capture_logs() as logged:
        async with source:
            taken = await take_received(source, 2)
    block = np.concatenate([received.samples for received in taken])
    assert block["voltage_v"].tolist() == [52.1, 52.2]
    assert block["current_a"].tolist() == [-2.0, -2.0]
    assert block["temperature_c"].tolist() == [21.5, 21.5]
    assert np.array_equal(taken[-1].cells_v, [[52.2 / 16, np.nan]], equal_nan=True)
    assert source.silence_reason is None
    assert source.counters["frames_received"] == 2
    assert source.counters["reconnects"] == 1
    reasons = [line["reason"] for line in logged if line["event"] == "no samples"]
    assert reasons == [
        f"a device: {reason}; trying again"
        for reason in ("no answer", "[Errno 113] No route to host", "[Errno 5] Input/output error")
    ]


async def test_capture_of_lines_replays_bit_identically(tmp_path: Path):
    path = tmp_path / "lines.raw"
    sensor = SensorSettings(protocol="text", current_sign="charge_positive")
    _connected, third_sample = lines(52.0)
    sent_lines = [*lines(50.0, 51.0), b"junk\n", third_sample, sample_json_line(53.0, 1.25, time_s=7.5)]
    with CaptureRecorder(path, make_header(sensor)) as recorder:
        source = LineSource(ScriptedProducer(sent_lines), sensor, tap=recorder)
        async with source:
            live = await take(source, 4)
    capture = RawCapture(path)
    replayed = np.concatenate(list(capture))
    assert [replayed[name].tobytes() for name in SAMPLE.names or ()] == [live[name].tobytes() for name in SAMPLE.names]
    assert live["current_a"].tolist() == [2.0, 2.0, 2.0, -1.25]
    assert source.counters == {**capture.decoder.counters, "reconnects": 0, "missed_reads": 0}
    assert capture.decoder.counters["text_errors"] == 1


async def test_missing_and_invalid_lines_are_reported():
    junk = [CONNECTED, b'{"soc":1}\n', b'{"voltage":"unavailable"}\n']
    for script, message in (
        ([CONNECTED], "a device: connected, but silent"),
        (junk, 'a device: lines without voltage and current arrive; the first: \'{"voltage":"unavailable"}\''),
    ):
        source = LineSource(ScriptedProducer(script), TEXT, period_s=0.001, check_interval_s=0.001)
        async with source:
            taking = asyncio.create_task(take(source, 1))
            await wait_for_message(source, message)
            taking.cancel()


async def test_fault_of_a_producer_is_reported_from_its_connection_on():
    class FaultyProducer(ScriptedProducer):
        fault = "no message on x"

    async with LineSource(FaultyProducer([CONNECTED]), TEXT, period_s=LONG_S) as source:
        await wait_for_message(source, "a device: no message on x")


async def test_error_that_is_a_bug_of_the_producer_is_raised():
    source = LineSource(ScriptedProducer([*lines(50.0), KeyError("bug")]), TEXT)
    async with source:
        with pytest.raises(KeyError, match="bug"):
            await take(source, 2)


@pytest.mark.parametrize("values", [(float("nan"), 1.0), (50.0, float("inf"))])
def test_json_line_of_a_value_that_is_not_finite_is_rejected(values: tuple[float, float]):
    with pytest.raises(ValueError, match="no sample"):
        sample_json_line(*values)


def test_source_sets_defaults_of_the_sensor_which_settings_override():
    settings = Settings.model_validate({"source": {"kind": "linux", "voltage_scale": 4.0}})
    assert (settings.sensor.protocol, settings.sensor.voltage_resolution_v) == ("text", 5e-3)
    sensor = SensorSettings(voltage_resolution_v=0.1, current_sign="charge_positive")
    settings = Settings.model_validate({"source": {"kind": "linux"}, "sensor": sensor})
    gain_std = {"voltage_gain_std": 0.005, "current_gain_std": 0.005}
    assert settings.sensor == sensor.model_copy(update={"protocol": "text", "period_s": 1.0} | gain_std)
    assert settings.sensor.sample_period_s == 1.0


def test_values_of_what_a_device_does_not_measure_are_logged_once_with_their_quantity() -> None:
    fault_log = FaultLog()
    with capture_logs() as lines:
        for second in range(0, 3600, 2):
            fault_log.check({"implausible": second + 1, "implausible_cells": 20 * (second + 1)}, float(second))
    assert [line["event"] for line in lines] == ["faults on the line"]
    assert {"implausible_temperatures", "implausible_cell_voltages"} <= lines[0].keys()
