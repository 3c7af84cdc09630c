"""A user's first day with a 4S LFP pack: board, ``new``, ``doctor``, ``calibrate``, ``run`` and ``report``."""

import asyncio
import contextlib
import json
import math
import os
import signal
import tomllib
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bms_estimator.model.cell import load_cell
from bms_estimator.simulation.virtual_adc import BoardParts
from bms_estimator.simulation.virtual_board import VirtualBoard
from tests.command_line import PROGRAM
from tests.end_to_end.lfp_pack import (
    CAPACITY_FACTOR,
    RATED_AH,
    SERIES,
    Connected,
    LfpPack,
    accelerated_board,
    running_board,
)
from tests.mosquitto import Broker, Listener
from tests.patience import LONG_S

PARTS = BoardParts(divider=3.23, current_zero=0.503, bandgap_v=1.08)
"""The board as built. The label of its divider says 3.2."""
START_SOC, END_SOC = 0.5, 0.05
CALIBRATION_SPEED, RUN_SPEED = 300.0, 500.0
"""Speed of board and pack relative to real time, at 1 Hz."""
LOADS_A = (1.0, 0.4, 2.0, 0.0)
"""Currents of the load in use. Each lasts for ``LOAD_S``."""
LOAD_S = 300.0
POLL_S = 0.02
"""Interval at which the user looks at the pack [s]."""


class User:
    """User of the command line in one folder.

    Args:
        folder: Folder with the settings file.
        pack: The user's pack.
    """

    def __init__(self, folder: Path, pack: LfpPack) -> None:
        self.folder, self.pack = folder, pack
        self.file = folder / "pack.toml"

    async def type(self, *arguments: object) -> str:
        """Run a command, which must succeed, and return its output."""
        async with self.started(*arguments, stderr=asyncio.subprocess.STDOUT) as process:
            output, _ = await asyncio.wait_for(process.communicate(), LONG_S)
        assert process.returncode == 0, output.decode()
        return output.decode()

    @contextlib.asynccontextmanager
    async def started(self, *arguments: object, stderr: int | None = None) -> AsyncIterator[asyncio.subprocess.Process]:
        """Start a command; it is killed at the end if it still runs."""
        process = await asyncio.create_subprocess_exec(
            *(str(PROGRAM), *map(str, arguments)),
            cwd=self.folder,
            env=os.environ | {"XDG_STATE_HOME": str(self.folder / "state")},
            stdout=asyncio.subprocess.PIPE,
            stderr=stderr,
        )
        try:
            yield process
        finally:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.wait()

    def edit_settings(self, old: str, new: str) -> None:
        """Replace a text that occurs once in the settings file."""
        settings = self.file.read_text()
        assert settings.count(old) == 1, old
        self.file.write_text(settings.replace(old, new))

    async def calibrate(self) -> dict[str, Any]:
        """Follow the instructions of ``calibrate``, and return its result."""
        async with self.started("calibrate", "pack.toml", "--json", stderr=asyncio.subprocess.PIPE) as process:
            assert process.stderr
            assert process.stdout
            lines = []
            async with asyncio.timeout(LONG_S):
                async for line in process.stderr:
                    lines.append(line.decode())
                    self._follow(lines[-1])
            result = await process.stdout.read()
            assert await process.wait() == 0, "".join(lines)
        return dict(json.loads(result))

    def _follow(self, instruction: str) -> None:
        if "Charge the pack" in instruction:
            self.pack.connect(Connected.CHARGER)
        elif "Discharge the pack at about 1 A" in instruction:
            self.pack.connect(Connected.LOAD, 1.0)
        elif "Let the pack rest" in instruction or "Done" in instruction:
            self.pack.connect(Connected.NOTHING)

    async def use_pack(self) -> None:
        """Charge the pack, and then use it until ``END_SOC``."""
        self.pack.connect(Connected.CHARGER)
        while not self.pack.is_charged:  # noqa: ASYNC110 - the simulated charger has no event
            await asyncio.sleep(POLL_S)
        start_s = self.pack.history[-1][0]
        while self.pack.soc > END_SOC:
            number = int((self.pack.history[-1][0] - start_s) / LOAD_S)
            self.pack.connect(Connected.LOAD, LOADS_A[number % len(LOADS_A)])
            await asyncio.sleep(POLL_S)


async def run_and_use(user: User, board: VirtualBoard, broker: Broker) -> tuple[list[dict[str, Any]], float]:
    """Run the service while the pack is used. Return its states, and the time of the board at their time 0 [s]."""
    async with Listener(broker, "bms/#") as listener, user.started("run", "pack.toml") as service:
        await listener.wait("bms/house/availability", lambda payload: payload == b"online")
        async with running_board(board):  # the service drops samples until the board's hello
            state = await listener.wait_json("bms/house/state")
            first_s = board.time_s - state["board_time_s"]
        async with accelerated_board(board, RUN_SPEED):
            await user.use_pack()
        end_s = board.time_s - first_s
        await listener.wait_json("bms/house/state", lambda state: state["board_time_s"] > end_s - 0.5 * LOAD_S)
        service.send_signal(signal.SIGTERM)
        await asyncio.wait_for(service.communicate(), LONG_S)
        assert service.returncode == 0
        return [json.loads(payload) for payload in listener.all("bms/house/state")], first_s


@pytest.mark.timeout(1800)
async def test_a_new_pack_is_calibrated_and_its_soc_is_within_the_band(tmp_path: Path, broker: Broker) -> None:
    pack = LfpPack(START_SOC)
    user = User(tmp_path, pack)
    with VirtualBoard(pack, parts=PARTS) as board:
        async with running_board(board):
            await user.type("board", board.path, "--aref-v", "5.0", "--divider", "3.2")
            await user.type(
                *("new", "--device", board.path, "--voltmeter-v", f"{pack.voltage_v:.2f}", "--zero"),
                *("--name", "house", "--cell", "lfp", "--capacity-ah", RATED_AH, "--series", SERIES),
                *("--parallel", 1, "--broker", broker.url, "--no-estimate", "--no-install"),
            )
            user.edit_settings("#sample_rate_hz = 100", "sample_rate_hz = 1")
            user.edit_settings("#rate_hz = 1.0", "rate_hz = 10")
            findings = json.loads(await user.type("doctor", "--json"))
        async with accelerated_board(board, CALIBRATION_SPEED):
            calibration = await user.calibrate()
        user.edit_settings('cell = "lfp"', 'cell = "cell.toml"')
        user.edit_settings(f"capacity_ah = {RATED_AH}", "#capacity_ah =")
        states, first_s = await run_and_use(user, board, broker)
    report = await user.type("report", "--pack", "pack.toml")

    levels = {finding["check"]: finding["level"] for finding in findings["findings"]}
    assert findings["ok"]
    assert {levels[name] for name in ("settings", "port", "device", "board", "broker")} == {"ok"}
    assert calibration["resistances_identified"]
    assert calibration["capacity_ah"] == pytest.approx(CAPACITY_FACTOR * RATED_AH, rel=0.02)
    assert load_cell(tmp_path / "cell.toml").cell.capacity_ah == pytest.approx(calibration["capacity_ah"])
    assert tomllib.loads(user.file.read_text())["pack"]["cell"] == "cell.toml"
    check_soc(states, first_s, pack)
    assert "The pack's SOC at the end is" in report
    assert "</html>" in (tmp_path / "report.html").read_text()


def check_soc(states: list[dict[str, Any]], first_s: float, pack: LfpPack) -> None:
    """Compare the published SOC with the true one. A band of 2 std may miss 5 % of the states."""
    time_s, true_soc = np.array(pack.history).T
    at_s = np.array([state["board_time_s"] for state in states]) + first_s
    error = np.array([state["soc"] for state in states]) - np.interp(at_s, time_s, true_soc)
    error_in_std = np.abs(error) / np.array([state["soc_std"] for state in states])
    assert len(states) > 50
    assert math.isclose(at_s[-1], time_s[-1], abs_tol=LOAD_S)
    assert np.mean(error_in_std <= 2.0) >= 0.95
    assert error_in_std.max() < 3.0
    assert abs(error[-1]) < 0.02
