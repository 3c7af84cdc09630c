"""End-to-end test: simulated cell, board, serial line, program, broker, and subscriber."""

import asyncio
import contextlib
import json
import signal
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from bms_estimator.checkpoint.state_files import CheckpointFile
from bms_estimator.cli.options.pack_options import load_pack
from bms_estimator.estimator.estimator import compiled_estimator
from bms_estimator.kernels.kalman_filter.records import SCRATCH
from bms_estimator.model.arrays import fields
from bms_estimator.model.cell import load_cell
from bms_estimator.pack.pack import Pack
from bms_estimator.pack_model.slow_fit import SlowFit
from bms_estimator.protocols.firmware.messages import ResetCause
from bms_estimator.simulation.simulated_pack import SimulatedPack, pulses
from bms_estimator.simulation.virtual_adc import Reading
from bms_estimator.simulation.virtual_board import BoardFault, VirtualBoard
from bms_estimator.sources.captures.replay import RawCapture
from tests.command_line import PROGRAM
from tests.mosquitto import Broker, Listener
from tests.patience import LONG_S
from tests.simavr_board import SimavrBoard, write_readings

LSB_V, LSB_A = 25.0 / 1024.0, 5.0 / 1024.0 / 0.1
"""Resolution of the board's voltage [V] and current [A]."""
START_SOC = 0.9
LOAD_A = 0.3
PERIOD_S = 0.02
"""Period of the readings of the simulated cell [s]."""
RUN_S = 14.0
"""Time of the board until which states are compared [s]. It contains a pulse and a rest."""
EDGE_S = 0.3
"""Difference between the clocks of board and cell, plus a publish window [s]."""


class SimulatedCell:
    """A minute of a simulated cell under pulses of 10 s, sampled at 50 Hz: true SOC [1], current [A] and voltage [V]."""

    def __init__(self) -> None:
        pack = SimulatedPack(load_cell("chen_mora"), pulses(LOAD_A), soc=START_SOC)
        self.time_s = np.arange(0.0, 60.0, PERIOD_S)
        self.readings: list[Reading] = []
        socs = []
        for at_s in self.time_s:
            self.readings.append(pack(float(at_s)))
            socs.append(pack.soc)
        self.soc = np.array(socs)
        self.current_a = np.array([r.current_a for r in self.readings])
        self.voltage_v = np.array([r.voltage_v for r in self.readings])

    def reading(self, at_s: float) -> Reading:
        """Return the reading at a time [s]."""
        return self.readings[min(round(at_s / PERIOD_S), len(self.readings) - 1)]

    def at(self, values: np.ndarray, at_s: float) -> float:
        """Return the true value at a time [s]. ``values`` is one of the arrays of this object."""
        return float(np.interp(at_s, self.time_s, values))

    def is_steady(self, at_s: float) -> bool:
        """Return True if the current is constant within ``EDGE_S`` of a time [s]."""
        is_near = np.abs(self.time_s - at_s) < EDGE_S
        return bool(np.ptp(self.current_a[is_near]) == 0.0)


@pytest.fixture(scope="module")
def simulated() -> SimulatedCell:
    return SimulatedCell()


def pack_file(folder: Path, port: str, broker: Broker) -> Path:
    path = folder / "pack.toml"
    path.write_text(f"""
[pack]
cell = "chen_mora"
initial_soc = {START_SOC}
[sensor]
port = "{port}"
[publish]
rate_hz = 10
[mqtt]
url = "{broker.url}"
[state]
folder = "{folder / "state"}"
""")
    return path


@contextlib.asynccontextmanager
async def run_program(pack: Path, *options: str) -> AsyncIterator[asyncio.subprocess.Process]:
    """Run the service of a pack file, and end it by SIGTERM."""
    process = await asyncio.create_subprocess_exec(
        str(PROGRAM), "run", str(pack), *options, stdout=asyncio.subprocess.DEVNULL, stderr=None
    )
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.send_signal(signal.SIGTERM)
        assert await asyncio.wait_for(process.wait(), LONG_S) == 0


class Board(NamedTuple):
    """Board that measures the simulated cell, with a function that starts it."""

    path: str
    power_up: Callable[[], None]


@contextlib.asynccontextmanager
async def run_board(board_kind: str, simulated: SimulatedCell, folder: Path) -> AsyncIterator[Board]:
    """Yield a board that runs in Python, or whose firmware runs in simavr."""
    if board_kind == "python":
        with VirtualBoard(simulated.reading) as board, contextlib.ExitStack() as stack:
            yield Board(board.path, lambda: stack.callback(asyncio.create_task(board.run()).cancel))
    else:
        rows = [(t, *r) for t, r in zip(simulated.time_s, simulated.readings, strict=True)]
        with SimavrBoard(write_readings(folder / "readings.csv", rows)) as simavr_board:
            yield Board(simavr_board.path, power_up=lambda: None)  # it starts when its line is opened


@pytest.fixture(params=["simavr", pytest.param("python", marks=pytest.mark.thorough)])
def board_kind(request: pytest.FixtureRequest) -> str:
    if request.param == "simavr":
        request.getfixturevalue("firmware")
    return str(request.param)


async def test_published_values_equal_the_simulated_ones_within_the_resolution_of_the_adc(
    board_kind: str, simulated: SimulatedCell, tmp_path: Path, broker: Broker
) -> None:
    async with (
        run_board(board_kind, simulated, tmp_path) as board,
        Listener(broker, "bms/#") as listener,
        run_program(pack_file(tmp_path, board.path, broker)),
    ):
        await listener.wait("bms/pack/availability", lambda p: p == b"online")
        board.power_up()
        await listener.wait_json("bms/pack/state")
        await listener.wait_json("bms/pack/state", lambda s: s["board_time_s"] > RUN_S)
    published = [json.loads(payload) for payload in listener.all("bms/pack/state")]
    states = [s for s in published if simulated.is_steady(s["board_time_s"])]
    assert len(states) > 50
    for state in states:
        at_s = state["board_time_s"]
        assert abs(state["voltage_v"] - simulated.at(simulated.voltage_v, at_s)) < LSB_V
        assert abs(state["current_a"] - simulated.at(simulated.current_a, at_s)) < LSB_A
        assert abs(state["soc_coulomb"] - simulated.at(simulated.soc, at_s)) < 0.001
        assert abs(state["soc"] - simulated.at(simulated.soc, at_s)) < max(3.0 * state["soc_std"], 0.01)
        assert abs(state["voltage_estimate_v"] - simulated.at(simulated.voltage_v, at_s)) < 2.0 * LSB_V
    errors_v = [s["voltage_v"] - simulated.at(simulated.voltage_v, s["board_time_s"]) for s in states]
    assert abs(np.mean(errors_v)) < 0.25 * LSB_V
    last = states[-1]
    assert last["lock"]
    assert last["temperature_c"] == pytest.approx(25.0, abs=1.0)
    assert (last["frames_lost"], last["crc_errors"]) == (0, 0)
    assert last["sample_rate_hz"] == pytest.approx(100.0, rel=1e-3)
    info = await listener.wait_json("bms/pack/info", lambda i: i["board"])
    assert info["board"]["firmware"]


async def test_a_replay_of_a_recording_gives_exactly_the_state_of_the_live_run(
    simulated: SimulatedCell, tmp_path: Path, broker: Broker
) -> None:
    capture = tmp_path / "line.bms"
    with VirtualBoard(simulated.reading) as board:
        pack = pack_file(tmp_path, board.path, broker)
        running = asyncio.create_task(board.run())
        async with Listener(broker, "bms/#") as listener, run_program(pack, "--record", str(capture)):
            for number, event in enumerate(line_events(board), start=1):
                await listener.wait_json("bms/pack/health", lambda h, n=number: h["line"]["frames_received"] >= 60 * n)
                event()
            await listener.wait_json("bms/pack/health", lambda h: h["line"]["resets"] and h["samples"]["samples"] > 450)
        running.cancel()
    settings, cell = load_pack(pack)
    live = CheckpointFile(tmp_path / "state", settings, cell).load().record
    replayed = compiled_estimator(settings, cell)
    pack_replay, capture_file = Pack(replayed, SlowFit(replayed)), RawCapture(capture)
    for block in capture_file:
        pack_replay.run(block)
    counters = capture_file.decoder.counters
    assert counters["frames_lost"] > 0
    assert counters["crc_errors"] > 0
    assert counters["resets"] == 1
    assert live["observer.samples"][0] > 450
    replayed.record["filter"][SCRATCH] = 0.0
    for name, field in fields(replayed.record):
        assert live[name].tobytes() == field.tobytes(), name


def line_events(board: VirtualBoard) -> list[Callable[[], None]]:
    """Return functions, each of which causes a fault of the line in three frames; the last resets the board."""
    faults = [lambda fault=fault: board.inject(fault, 3) for fault in BoardFault]  # type: ignore[misc]
    return [*faults, lambda: board.reset(ResetCause.BROWN_OUT)]
