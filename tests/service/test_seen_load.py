"""Observed load: it survives a restart of the service, and a damaged file is dropped."""

import asyncio
from pathlib import Path

import numpy as np
import pytest
from structlog.testing import capture_logs

from bms_estimator.checkpoint.state_files import StateFiles
from bms_estimator.model.arrays import SampleBlock
from bms_estimator.model.cell import load_cell
from bms_estimator.mqtt.connection import DeliveryStats
from bms_estimator.service.live_loop import ServiceParts, run_estimation_loop
from bms_estimator.settings.pack import Settings
from bms_estimator.sinks.mqtt.requests import RequestDispatcher
from tests.patience import LONG_S
from tests.scripted_source import ScriptedSource

CELL = load_cell("ncr18650")
SETTINGS = Settings.model_validate({"pack": {"name": "bike", "initial_soc": 0.8, "cutoff_v": 2.8}})


def discharge(seconds: int) -> SampleBlock:
    """Return samples of a discharge at 1 Hz."""
    source = ScriptedSource()
    source.give(*((float(s), 1.5 + np.sin(0.1 * s), 3.8 - 1e-4 * s, 25.0, 0) for s in range(seconds)))
    block = source._queue.get_nowait()
    assert block is not None
    return block


async def run_service(folder: Path, samples: SampleBlock) -> bytes:
    """Run the service over samples until they end. Return the answer to a request ``forecast`` then."""
    source, requests = ScriptedSource(), RequestDispatcher(DeliveryStats())
    source._queue.put_nowait(samples)
    source.finish()
    await asyncio.wait_for(
        run_estimation_loop(
            SETTINGS,
            CELL,
            source=source,
            sinks=[],
            stop=asyncio.Event(),
            files=StateFiles(folder, SETTINGS, CELL),
            parts=ServiceParts(requests=requests),
        ),
        LONG_S,
    )
    answer = await requests.handle("forecast", b"")
    assert answer
    return answer


@pytest.fixture
async def folder(tmp_path: Path) -> Path:
    """Return the state folder after a run with ten minutes of load."""
    assert b'"reason":null' in await run_service(tmp_path, discharge(600))
    return tmp_path


async def test_forecast_after_a_restart_uses_the_load_before_it(folder: Path) -> None:
    assert b'"reason":null' in await run_service(folder, discharge(5))


async def test_damaged_load_is_dropped_with_the_reason_and_replaced(folder: Path) -> None:
    file = StateFiles(folder, SETTINGS, CELL).load
    file.path.write_bytes(b"damaged")
    with capture_logs() as lines:
        answer = await run_service(folder, discharge(5))
    [warning] = [line for line in lines if line["event"] == "load"]
    assert warning["outcome"].startswith("refused: damaged")
    assert b"less than 300 s of load" in answer
    assert file.load()


async def test_state_without_a_saved_load_is_restored(folder: Path) -> None:
    """Earlier versions did not save the load."""
    StateFiles(folder, SETTINGS, CELL).load.path.unlink()
    with capture_logs() as lines:
        assert b"less than 300 s of load" in await run_service(folder, discharge(5))
    assert any("restored" in str(line.get("outcome")) for line in lines)
