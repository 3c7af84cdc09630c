"""Simulated BMS on a pseudo-terminal read by the real serial source: values, cells, faults, silence, replay."""

import asyncio
import contextlib
import math
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import numpy as np
import pytest

from bms_estimator.model.sample import SampleBlock
from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.simulation.bms_answers import BMS_ANSWERS
from bms_estimator.simulation.simulated_bms import SPREAD_V, BmsFault, SimulatedBms
from bms_estimator.simulation.virtual_adc import Reading
from bms_estimator.sources.captures.raw_capture import make_header
from bms_estimator.sources.captures.recorder import CaptureRecorder
from bms_estimator.sources.captures.replay import RawCapture
from bms_estimator.sources.serial.serial_source import SerialSource
from tests.patience import LONG_S

CELLS = 16
RESOLVED = {"jbd": (0.01, 0.01, 0.1), "daly": (0.1, 0.1, 1.0), "jk": (0.01, 0.01, 1.0), "jk-pb": (0.001, 0.001, 0.1)}
"""Voltage [V], current [A], temperature [K] by protocol."""
COUNTED = {
    BmsFault.CORRUPT: ("crc_errors", "length_errors", "noise_bytes"),
    BmsFault.SHORT: ("short_frames", "crc_errors", "noise_bytes"),
    BmsFault.NOISE: ("noise_bytes",),
}
"""Where a fault shows."""
FASTER = {
    "protocols.base.polled_protocol.POLL_CYCLE_S": 0.1,
    "protocols.base.polled_protocol.QUERY_INTERVAL_S": 0.01,
    "sources.serial.serial_source.SEND_INTERVAL_S": 0.02,
}
"""Than a BMS is asked, to spare time."""


def swinging(time_s: float) -> Reading:
    """A load that charges and discharges; current and voltage are the same sine."""
    return Reading(40.0 * math.sin(time_s), 52.8 - math.sin(time_s), 21.0)


class Taken:
    """What a source has brought."""

    def __init__(self) -> None:
        self.blocks = list[SampleBlock]()
        self.cells: list[list[float]] = []

    @property
    def count(self) -> int:
        return sum(block.size for block in self.blocks)

    async def take(self, source: SerialSource) -> None:
        async for block in source:
            self.blocks.append(block.copy())
            self.cells += source.cells.tolist()

    async def more(self, samples: int) -> None:
        enough = self.count + samples
        await until(lambda: self.count >= enough)


async def until(condition: Callable[[], object]) -> None:
    async with asyncio.timeout(LONG_S):
        while not condition():  # noqa: ASYNC110 - the condition is the test's
            await asyncio.sleep(0.01)


@contextlib.asynccontextmanager
async def read(bms: SimulatedBms, protocol: str, tap: CaptureRecorder) -> AsyncIterator[tuple[SerialSource, Taken]]:
    """The reader of the line of a BMS that answers."""
    with bms:
        sensor = SensorSettings.model_validate({"port": bms.path, "protocol": protocol})
        taken = Taken()
        async with SerialSource(sensor, tap=tap, first_retry_s=0.05, silent_s=0.5) as board:
            tasks = [asyncio.create_task(bms.run()), asyncio.create_task(taken.take(board))]
            try:
                yield board, taken
            finally:
                for task in tasks:
                    task.cancel()
                await asyncio.gather(*tasks, return_exceptions=True)


@pytest.mark.parametrize("name", BMS_ANSWERS)
async def test_it_is_read_recorded_and_replayed_to_the_same_bits_whatever_happens_to_its_answers(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for constant, value in FASTER.items():
        monkeypatch.setattr(f"bms_estimator.{constant}", value)
    protocol, path = name.removesuffix("-pb"), tmp_path / "line.bms"
    bms = SimulatedBms(name, swinging, cells=CELLS)
    header = make_header(SensorSettings.model_validate({"protocol": protocol}))
    with CaptureRecorder(path, header) as recording:
        async with read(bms, protocol, recording) as (board, taken):
            await taken.more(2)
            assert (board.message, board.counters["crc_errors"], board.counters["noise_bytes"]) == (None, 0, 0)
            for fault, names in COUNTED.items():
                before = sum(board.counters[counter] for counter in names)
                bms.inject(fault)
                await until(lambda: sum(board.counters[c] for c in names) > before)  # noqa: B023 - awaited here
                await taken.more(1)
            bms.inject(BmsFault.SILENCE, 1_000_000)
            await until(lambda: board.message)
            assert "open, but silent" in (board.message or "")
            bms.clear_faults()
            await taken.more(1)
            assert board.message is None
            counters = board.counters
    live = np.concatenate(taken.blocks)
    step_v, step_a, step_k = RESOLVED[name]
    assert np.abs(live["temperature_c"] - 21.0).max() <= step_k / 2 + 1e-9
    assert np.abs(live["current_a"] / 40.0 - (52.8 - live["voltage_v"])).max() <= (step_v + step_a / 40.0) / 2 + 1e-9
    whole = [row for row in taken.cells if not any(math.isnan(v) for v in row)]
    assert len(whole) >= 3
    assert {len(row) for row in whole} == {CELLS}
    assert max(abs(v - sum(row) / CELLS) for row in whole for v in row) < 2 * SPREAD_V + 1e-3
    replay = RawCapture(path)
    replayed = np.concatenate(list(replay))
    for column in ("time_s", "voltage_v", "current_a", "temperature_c", "status"):
        assert replayed[column].tobytes() == live[column].tobytes()
    assert replay.decoder.counters == {counter: counters[counter] for counter in replay.decoder.counters}


def test_more_cells_than_a_bms_has_room_for_are_refused() -> None:
    with pytest.raises(ValueError, match="40 cells: a simulated BMS has 1 to 32"):
        SimulatedBms("jbd", swinging, cells=40)
