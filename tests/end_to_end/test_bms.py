"""End-to-end test with a BMS: simulated pack, JK-BMS, serial line, program, and broker."""

import asyncio
import contextlib
import math
import signal
from pathlib import Path

import pytest

from bms_estimator.model.cell import load_cell
from bms_estimator.simulation.simulated_bms import MAX_CELL_DEVIATION_V, SimulatedBms
from bms_estimator.simulation.simulated_pack import SimulatedPack, constant
from tests.command_line import PROGRAM
from tests.mosquitto import Broker, Listener
from tests.patience import LONG_S

CELL_COUNT, LOAD_A, START_SOC = 16, 20.0, 0.6
MIN_SAMPLES = 5
"""Number of samples after which the published state is checked."""


@pytest.mark.thorough
async def test_soc_and_cell_voltages_of_a_jk_bms_are_published(tmp_path: Path, broker: Broker) -> None:
    simulated_pack = SimulatedPack(load_cell("lfp", 100.0).pack(CELL_COUNT, 1), constant(LOAD_A), soc=START_SOC)
    simulated_bms = SimulatedBms("jk", simulated_pack, cells=CELL_COUNT, soc=lambda: simulated_pack.soc)
    pack = tmp_path / "pack.toml"
    with simulated_bms:
        pack.write_text(f"""
[pack]
cell = "lfp"
capacity_ah = 100.0
series = {CELL_COUNT}
initial_soc = {START_SOC}
[sensor]
port = "{simulated_bms.path}"
protocol = "jk"
[mqtt]
url = "{broker.url}"
[state]
folder = "{tmp_path / "state"}"
""")
        running = asyncio.create_task(simulated_bms.run())
        async with Listener(broker, "bms/#") as listener:
            process = await asyncio.create_subprocess_exec(
                str(PROGRAM), "run", str(pack), stdout=asyncio.subprocess.DEVNULL
            )
            try:
                state = await listener.wait_json("bms/pack/state", lambda s: s["frames_received"] >= MIN_SAMPLES)
                await listener.wait("bms/pack/sensor/availability", lambda p: p == b"online")
            finally:
                with contextlib.suppress(ProcessLookupError):
                    process.send_signal(signal.SIGTERM)
                assert await asyncio.wait_for(process.wait(), LONG_S) == 0
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
    assert state["current_a"] == pytest.approx(LOAD_A, abs=0.01)
    assert state["soc"] == pytest.approx(simulated_pack.soc, abs=0.02)
    assert state["temperature_c"] == 25.0
    assert len(state["cells_v"]) == CELL_COUNT
    assert math.fsum(state["cells_v"]) == pytest.approx(state["voltage_v"], abs=0.02)
    # the simulated cells lie within MAX_CELL_DEVIATION_V of their mean; the BMS reports whole millivolts
    assert max(state["cells_v"]) - min(state["cells_v"]) < 2 * MAX_CELL_DEVIATION_V + 1e-3
    assert state["cells_v"][state["cell_lowest"] - 1] == min(state["cells_v"])
    assert (state["frames_lost"], state["crc_errors"]) == (0, 0)
