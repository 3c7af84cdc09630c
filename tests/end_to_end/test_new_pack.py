"""A user's first day with a 4S LFP pack: board, ``new``, ``doctor``, ``calibrate``, ``run`` and ``report``."""

import asyncio
import json
import math
import os
import signal
import tomllib
from asyncio.subprocess import Process
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bms_estimator.model.cell import load_cell
from tests.command_line import PROGRAM, running_program
from tests.end_to_end.lfp_boards import Board, open_board
from tests.end_to_end.lfp_pack import (
    CAPACITY_FACTOR,
    RATED_AH,
    SERIES,
    Connected,
    LfpPack,
)
from tests.mosquitto import Broker, Listener
from tests.patience import LONG_S

CALIBRATION_SPEED, RUN_SPEED = 1000.0, 500.0
"""Maximum speeds of the virtual board relative to real time, at 1 Hz."""


@dataclass(frozen=True)
class Usage:
    """Use of a pack in a test.

    Attributes:
        divider: Ratio on the label of the board's divider.
        start_soc: SOC when the user gets the pack.
        end_soc: SOC at which the user ends the run.
        charger_a: Maximum current of the charger [A].
    """

    divider: float
    start_soc: float
    end_soc: float
    charger_a: float


USAGES = {"python": Usage(3.2, 0.5, 0.05, 1.0), "simavr": Usage(6.0, 0.97, 0.7, 2.0)}
"""Use of the pack by kind of board. With simavr the charge and the use are shorter, because simavr is slower."""
LOADS_A = (1.0, 0.4, 2.0, 0.0)
"""Currents of the load in use. Each lasts for ``LOAD_S``."""
LOAD_S = 300.0
POLL_S = 0.02
"""Interval at which the user checks the pack [s]."""


class User:
    """User of the command line in one folder.

    Args:
        folder: Folder with the settings file.
        pack: The user's pack.
        usage: Use of the pack.
    """

    def __init__(self, folder: Path, pack: LfpPack, usage: Usage) -> None:
        self.folder, self.pack, self.usage = folder, pack, usage
        self.file = folder / "pack.toml"

    async def type(self, *arguments: object) -> str:
        """Run a command, which must succeed, and return its output."""
        async with self.started(*arguments, stderr=asyncio.subprocess.STDOUT) as process:
            output, _ = await asyncio.wait_for(process.communicate(), LONG_S)
        assert process.returncode == 0, output.decode()
        return output.decode()

    def started(self, *arguments: object, stderr: int | None = None) -> AbstractAsyncContextManager[Process]:
        """Start a command; it is killed at the end if it still runs."""
        env = os.environ | {"XDG_STATE_HOME": str(self.folder / "state")}
        return running_program(PROGRAM, *arguments, stderr=stderr, folder=self.folder, env=env)

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

    async def use_pack(self) -> float:
        """Charge the pack, and then use it until ``end_soc``. Return the time at which the charge began [s]."""
        charge_s = self.pack.history[-1][0]
        self.pack.connect(Connected.CHARGER)
        while not self.pack.is_charged:  # noqa: ASYNC110 - the simulated charger has no event
            await asyncio.sleep(POLL_S)
        start_s = self.pack.history[-1][0]
        while self.pack.soc > self.usage.end_soc:
            number = int((self.pack.history[-1][0] - start_s) / LOAD_S)
            self.pack.connect(Connected.LOAD, LOADS_A[number % len(LOADS_A)])
            await asyncio.sleep(POLL_S)
        return charge_s


async def run_and_use(user: User, board: Board, broker: Broker) -> tuple[list[dict[str, Any]], float]:
    """Run the service while the pack is used. Return the published states, and the pack's time at which ``board_time_s`` is 0 [s]."""
    async with Listener(broker, "bms/#") as listener, user.started("run", "pack.toml") as service:
        await listener.wait("bms/house/availability", lambda payload: payload == b"online")
        async with board.running():  # the service drops samples until the board's hello
            await listener.wait_json("bms/house/state")
        async with board.accelerated(RUN_SPEED):
            charge_s = await user.use_pack()
            end_s = user.pack.history[-1][0]
            states = [json.loads(payload) for payload in listener.all("bms/house/state")]
            board_start_s = charge_s - begin_of_charge_s(states, user.usage.charger_a)
            await listener.wait_json(
                "bms/house/state", lambda state: state["board_time_s"] > end_s - board_start_s - 0.5 * LOAD_S
            )
        service.send_signal(signal.SIGTERM)
        await asyncio.wait_for(service.communicate(), LONG_S)
        assert service.returncode == 0
        return [json.loads(payload) for payload in listener.all("bms/house/state")], board_start_s


def begin_of_charge_s(states: list[dict[str, Any]], charger_a: float) -> float:
    """Return the time in the states at which the first charge began [s].

    The current of a state is the mean since the previous state, so that it determines the time between both.
    """
    first = next(number for number, state in enumerate(states) if state["current_a"] < -0.01 * charger_a)
    time_s, previous_s = states[first]["board_time_s"], states[first - 1]["board_time_s"]
    return float(time_s + states[first]["current_a"] / charger_a * (time_s - previous_s))


@pytest.fixture(
    params=[
        pytest.param("python", marks=pytest.mark.timeout(1800)),
        pytest.param("simavr", marks=pytest.mark.timeout(3600)),
    ]
)
def board_kind(request: pytest.FixtureRequest) -> str:
    if request.param == "simavr":
        request.getfixturevalue("firmware")
    return str(request.param)


@pytest.mark.thorough
async def test_a_new_pack_is_calibrated_and_its_soc_is_within_the_band(
    board_kind: str, tmp_path: Path, broker: Broker
) -> None:
    usage = USAGES[board_kind]
    pack = LfpPack(usage.start_soc, usage.charger_a)
    user = User(tmp_path, pack, usage)
    async with open_board(board_kind, pack) as board:
        async with board.running():
            await user.type("board", board.path, "--aref-v", "5.0", "--divider", usage.divider)
            await user.type(
                *("new", "--device", board.path, "--voltmeter-v", f"{pack.voltage_v:.2f}", "--zero"),
                *("--name", "house", "--cell", "lfp", "--capacity-ah", RATED_AH, "--series", SERIES),
                *("--parallel", 1, "--full-voltage-v", "none", "--cutoff-voltage-v", "none"),
                *("--max-discharge-a", "none", "--max-charge-a", "none"),
                *("--broker", broker.url, "--no-estimate", "--no-install"),
            )
            user.edit_settings("#sample_rate_hz = 100", "sample_rate_hz = 1")
            user.edit_settings("#rate_hz = 1.0", "rate_hz = 10")
            findings = json.loads(await user.type("doctor", "--json"))
        async with board.accelerated(CALIBRATION_SPEED):
            calibration = await user.calibrate()
        user.edit_settings('cell = "lfp"', 'cell = "cell.toml"')
        user.edit_settings(f"capacity_ah = {RATED_AH}", "#capacity_ah =")
        states, board_start_s = await run_and_use(user, board, broker)
    report = await user.type("report", "--pack", "pack.toml")

    levels = {finding["check"]: finding["level"] for finding in findings["findings"]}
    assert findings["ok"]
    assert {levels[name] for name in ("settings", "port", "device", "board", "broker")} == {"ok"}
    assert calibration["resistances_identified"]
    assert calibration["capacity_ah"] == pytest.approx(CAPACITY_FACTOR * RATED_AH, rel=0.02)
    calibrated = load_cell(tmp_path / "cell.toml").cell
    assert calibrated.capacity_ah == pytest.approx(calibration["capacity_ah"])
    assert calibrated.capacity_std == pytest.approx(0.02, abs=0.02)
    assert tomllib.loads(user.file.read_text())["pack"]["cell"] == "cell.toml"
    check_soc(states, board_start_s, pack)
    assert "The pack's SOC at the end is" in report
    assert "</html>" in (tmp_path / "report.html").read_text()


def check_soc(states: list[dict[str, Any]], board_start_s: float, pack: LfpPack) -> None:
    """Compare the published SOC with the true one."""
    time_s, true_soc = np.array(pack.history).T
    at_s = np.array([state["board_time_s"] for state in states]) + board_start_s
    error = np.array([state["soc"] for state in states]) - np.interp(at_s, time_s, true_soc)
    error_in_std = np.abs(error) / np.array([state["soc_std"] for state in states])
    assert len(states) > 50
    assert math.isclose(at_s[-1], time_s[-1], abs_tol=LOAD_S)
    assert error_in_std.max() < 2.0
    assert abs(error[-1]) < 0.02
