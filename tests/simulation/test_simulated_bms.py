"""Simulated BMS on a pseudo-terminal, read by the serial source: values, cells, faults, silence and replay."""

import asyncio
import contextlib
import math
from collections.abc import AsyncIterator
from pathlib import Path

import numpy as np
import pytest

from bms_estimator.model.arrays import SampleBlock
from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.simulation.bms_responses import BMS_RESPONSES
from bms_estimator.simulation.simulated_pack import MAX_CELL_DEVIATION_V, BmsFault, SimulatedBms
from bms_estimator.simulation.virtual_adc import Reading
from bms_estimator.sources.captures.raw_capture import make_header
from bms_estimator.sources.captures.recorder import CaptureRecorder
from bms_estimator.sources.captures.replay import RawCapture
from bms_estimator.sources.serial.serial_source import SerialSource
from tests.patience import until

CELLS = 16
RESOLUTIONS = {"jbd": (0.01, 0.01, 0.1), "daly": (0.1, 0.1, 1.0), "jk": (0.01, 0.01, 1.0), "jk-pb": (0.001, 0.001, 0.1)}
"""Resolution of voltage [V], current [A] and temperature [K] by protocol."""
FAULT_COUNTERS = {
    BmsFault.CORRUPT: ("crc_errors", "length_errors", "noise_bytes"),
    BmsFault.SHORT: ("short_frames", "crc_errors", "noise_bytes"),
    BmsFault.NOISE: ("noise_bytes",),
}
"""Counters of which at least one increases with a fault."""
SHORT_INTERVALS = {
    "protocols.base.polled_protocol.POLL_CYCLE_S": 0.1,
    "protocols.base.polled_protocol.QUERY_INTERVAL_S": 0.01,
    "sources.serial.serial_source.SEND_INTERVAL_S": 0.02,
}
"""Intervals that are shortened to save test time."""
AMPLITUDE_A = 40.0
"""Amplitude of the current. The amplitude of the voltage is 1 V."""
MEAN_V = 52.8
TEMPERATURE_C = 21.0


def alternating_load(time_s: float) -> Reading:
    """Return a reading with a sinusoidal current, and a voltage that falls in proportion to the current."""
    return Reading(AMPLITUDE_A * math.sin(time_s), MEAN_V - math.sin(time_s), TEMPERATURE_C)


class SampleRecord:
    """Samples and cell voltages that a source has delivered."""

    def __init__(self) -> None:
        self.blocks = list[SampleBlock]()
        self.cells: list[list[float]] = []

    @property
    def count(self) -> int:
        return sum(block.size for block in self.blocks)

    async def collect(self, source: SerialSource) -> None:
        async for block, cells_v, *_ in source:
            self.blocks.append(block.copy())
            self.cells += cells_v.tolist()

    async def wait_for_more(self, samples: int) -> None:
        """Wait until this number of further samples has arrived."""
        awaited_count = self.count + samples
        await until(lambda: self.count >= awaited_count)


@contextlib.asynccontextmanager
async def read_bms(
    bms: SimulatedBms, protocol: str, tap: CaptureRecorder
) -> AsyncIterator[tuple[SerialSource, SampleRecord]]:
    """Run the BMS and a serial source that reads it and passes its bytes to ``tap``. Yield source and record."""
    with bms:
        sensor = SensorSettings.model_validate({"port": bms.path, "protocol": protocol})
        record = SampleRecord()
        async with SerialSource(sensor, tap=tap, first_retry_s=0.05, silent_s=0.5) as board:
            tasks = [asyncio.create_task(bms.run()), asyncio.create_task(record.collect(board))]
            try:
                yield board, record
            finally:
                for task in tasks:
                    task.cancel()
                await asyncio.gather(*tasks, return_exceptions=True)


@pytest.mark.parametrize("name", BMS_RESPONSES)
async def test_replay_of_a_bms_with_faults_is_bit_identical_to_the_live_samples(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for constant, value in SHORT_INTERVALS.items():
        monkeypatch.setattr(f"bms_estimator.{constant}", value)
    protocol, path = name.removesuffix("-pb"), tmp_path / "line.bms"  # one protocol decodes both series of JK
    bms = SimulatedBms(name, alternating_load, cells=CELLS)
    header = make_header(SensorSettings.model_validate({"protocol": protocol}))
    with CaptureRecorder(path, header) as recording:
        async with read_bms(bms, protocol, recording) as (board, record):
            await record.wait_for_more(2)
            assert (board.silence_reason, board.counters["crc_errors"], board.counters["noise_bytes"]) == (None, 0, 0)
            for fault, names in FAULT_COUNTERS.items():
                before = sum(board.counters[counter] for counter in names)
                bms.inject(fault)
                await until(lambda: sum(board.counters[c] for c in names) > before)  # noqa: B023 - awaited here
                await record.wait_for_more(1)
            bms.inject(BmsFault.SILENCE, 1_000_000)  # until ``clear_faults``
            await until(lambda: board.silence_reason)
            assert "open, but silent" in (board.silence_reason or "")
            bms.clear_faults()
            await record.wait_for_more(1)
            assert board.silence_reason is None
            counters = board.counters
    live = np.concatenate(record.blocks)
    step_v, step_a, step_k = RESOLUTIONS[name]
    assert np.abs(live["temperature_c"] - TEMPERATURE_C).max() <= step_k / 2 + 1e-9
    # Voltage drop and current, both relative to their amplitude, differ only by the rounding of both.
    voltage_drop_v = MEAN_V - live["voltage_v"]
    max_error_v = (step_v + step_a / AMPLITUDE_A) / 2 + 1e-9
    assert np.abs(live["current_a"] / AMPLITUDE_A - voltage_drop_v).max() <= max_error_v
    # A row has NaN for the cells of a response that did not come.
    complete_rows = [row for row in record.cells if not any(math.isnan(v) for v in row)]
    assert len(complete_rows) >= 3
    assert {len(row) for row in complete_rows} == {CELLS}
    assert max(abs(v - sum(row) / CELLS) for row in complete_rows for v in row) < 2 * MAX_CELL_DEVIATION_V + 1e-3
    replay = RawCapture(path)
    replayed = np.concatenate(list(replay))
    for column in ("time_s", "voltage_v", "current_a", "temperature_c", "status"):
        assert replayed[column].tobytes() == live[column].tobytes()
    assert replay.decoder.counters == {counter: counters[counter] for counter in replay.decoder.counters}


def test_too_many_cells_for_a_bms_are_rejected() -> None:
    with pytest.raises(ValueError, match="40 cells: a simulated BMS has 1 to 32"):
        SimulatedBms("jbd", alternating_load, cells=40)
