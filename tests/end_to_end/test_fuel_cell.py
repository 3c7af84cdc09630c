"""End-to-end test with a fuel cell: simulated stack, board, serial line, program, and broker."""

import asyncio
import contextlib
import json
from pathlib import Path

import numpy as np
import pytest

from bms_estimator.calibration.fuel_cell_fit import KEYS
from bms_estimator.checkpoint.state_files import CheckpointFile
from bms_estimator.cli.options.pack_options import load_pack
from bms_estimator.estimator.estimator import compiled_estimator
from bms_estimator.estimator.restore import restore_state
from bms_estimator.simulation.virtual_adc import Reading
from bms_estimator.simulation.virtual_board import VirtualBoard
from bms_estimator.sources.captures.replay import RawCapture
from tests import mann_stack
from tests.end_to_end.test_whole_way import run_program
from tests.mosquitto import Broker, Listener

MIN_SAMPLES = 500
"""Number of samples after which the service is stopped."""
LSB_V = 25.0 / 1024.0
"""Resolution of the board's voltage [V]."""


def simulate_stack() -> list[Reading]:
    """Return readings of a simulated stack for a minute at 100 Hz, the rate of the board."""
    time_s, current_a = mann_stack.random_steps(60.0, 100.0, seed=2, highest_a=4.0)
    record = mann_stack.measured(time_s, current_a, noise_v=0.0)
    columns = (record.current_a, record.voltage_v, record.temperature_c)
    return [Reading(*map(float, row)) for row in zip(*columns, strict=True)]


@pytest.mark.thorough
async def test_a_fuel_cell_is_estimated_and_its_checkpoint_equals_a_replay_and_can_be_restored(
    tmp_path: Path, broker: Broker
) -> None:
    readings, pack, capture = simulate_stack(), tmp_path / "pack.toml", tmp_path / "line.bms"
    with VirtualBoard(lambda at_s: readings[min(int(100.0 * at_s), len(readings) - 1)]) as board:
        pack.write_text(f"""
[pack]
cell = "pem_30w"
[sensor]
port = "{board.path}"
[publish]
rate_hz = 10
[mqtt]
url = "{broker.url}"
[state]
folder = "{tmp_path / "state"}"
""")
        running = asyncio.create_task(board.run())
        async with Listener(broker, "bms/#") as listener, run_program(pack, "--record", str(capture)):
            await listener.wait_json("bms/pack/health", lambda h: h["samples"]["samples"] > MIN_SAMPLES)
            parameters = await listener.wait_json("bms/pack/parameters", lambda p: p["elements"])
        running.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await running
    state = json.loads(listener.all("bms/pack/state")[-1])
    for name in ("soc", "soc_percent", "remaining_capacity_ah", "delta_1", "time_to_cutoff_s"):
        assert state[name] is None
    assert 8.0 < state["voltage_v"] < 13.0
    assert state["lock"]
    assert state["frames_lost"] == 0
    errors_v = [json.loads(s)["innovation_v"] for s in listener.all("bms/pack/state")]
    assert np.sqrt(np.mean(np.square(errors_v))) < 4.0 * LSB_V
    assert tuple(parameters["elements"]) == KEYS
    assert (parameters["a"], parameters["soc"]) == ({}, None)
    info = json.loads(listener.all("bms/pack/info")[-1])
    assert (info["cell"], info["capacity_ah"], info["observer"]) == ("pem_30w", None, "learning")

    settings, cell = load_pack(pack)
    saved = CheckpointFile(tmp_path / "state", settings, cell).load()
    assert not saved.reasons
    replayed, resumed = compiled_estimator(settings, cell), compiled_estimator(settings, cell)
    for block in RawCapture(capture):
        replayed.run(block)
    assert saved.record["learning.theta"].tobytes() == replayed.record["learning"]["theta"].tobytes(), "to the last bit"
    assert restore_state(resumed, saved.record, unseen_s=10.0) == ""
    np.testing.assert_array_equal(resumed.record["learning"]["theta"], replayed.record["learning"]["theta"])
    not_finite = {**saved.record, "learning.theta": np.full_like(saved.record["learning.theta"], np.nan)}
    assert (
        restore_state(compiled_estimator(settings, cell), not_finite, unseen_s=10.0)
        == "theta of the learning is not finite"
    )
