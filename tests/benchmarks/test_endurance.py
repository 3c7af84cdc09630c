"""Short runs of two parts of ``make load``: serial bytes, and the attack by a lost sensor."""

from pathlib import Path

from tests.benchmarks.endurance import process_bytes
from tests.benchmarks.lost_sensor import LOSSES, attack
from tests.mosquitto import Broker


def test_ten_minutes_of_serial_bytes_are_estimated() -> None:
    decoder, estimator, _, _ = process_bytes(100, 600.0)
    assert decoder.counters["frames_received"] == estimator.state["samples"][0] == 60_000
    assert decoder.counters["frames_lost"] == decoder.counters["clock_jumps"] == 0


async def test_lost_sensor_raises_sensor_fault_and_runs_the_hook(broker: Broker, tmp_path: Path) -> None:
    losses = await attack(broker, tmp_path, lost_s=0.5)
    assert [loss.runs_before for loss in losses] == [
        (f"{alarm} raised", f"{alarm} cleared") for alarm in LOSSES.values()
    ]
