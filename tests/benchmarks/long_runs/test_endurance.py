"""Short runs of two parts of ``make load``: serial bytes, and a lost sensor."""

from pathlib import Path

import pytest

from tests.benchmarks.long_runs.endurance import process_bytes
from tests.benchmarks.long_runs.lost_sensor import ALARM_OF_QUANTITY, lose_quantities
from tests.mosquitto import Broker


def test_every_frame_of_ten_minutes_of_serial_bytes_reaches_the_estimator() -> None:
    decoder, estimator, _, _ = process_bytes(rate_hz=100, seconds=600.0)
    assert decoder.counters["frames_received"] == estimator.state["samples"][0] == 60_000
    assert decoder.counters["frames_lost"] == decoder.counters["clock_jumps"] == 0


@pytest.mark.thorough
async def test_each_lost_quantity_raises_sensor_fault_and_runs_the_hook_of_the_alarm_that_needs_it(
    broker: Broker, tmp_path: Path
) -> None:
    losses = await lose_quantities(broker, tmp_path, lost_s=0.5)
    assert [loss.runs for loss in losses] == [
        (f"{alarm} raised", f"{alarm} cleared") for alarm in ALARM_OF_QUANTITY.values()
    ]
