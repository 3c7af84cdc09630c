"""Programs that serve pages: start of any of them, and the service of a simulated pack whose board prints JSON lines."""

import asyncio
import contextlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

from bms_estimator.model.cell import load_cell
from bms_estimator.simulation.simulated_pack import SimulatedPack, random_steps
from tests.command_line import PROGRAM
from tests.mosquitto import Broker
from tests.patience import LONG_S
from tests.serial_line import Line

Values = dict[str, Any]
"""Values in one line of the board, by name."""
CELL, SERIES, PARALLEL = "ncr18650", 14, 10
PACK = f'cell = "{CELL}"\nseries = {SERIES}\nparallel = {PARALLEL}\ninitial_soc = 0.6'
"""Section ``[pack]`` of the simulated pack, without its name."""
CELL_DEVIATIONS_V = [1e-3 * d for d in (2, -1, 3, 0, -4, 1, 5, -2, 1, 2, -17, 1, 4, 5)]
"""Deviations of the simulated cells from their mean [V]. The eleventh cell has a low voltage."""


def simulated(load_a: float = 24.0, soc: float = 0.66) -> Callable[[float], Values]:
    """Return a function of the time [s] that returns the values of an e-bike pack under changing loads."""
    pack = SimulatedPack(load_cell(CELL).pack(SERIES, PARALLEL), random_steps(load_a, seed=4), soc=soc)

    def values_at(time_s: float) -> Values:
        reading = pack(time_s)
        mean_v = reading.voltage_v / SERIES
        cells = [round(mean_v + deviation_v, 4) for deviation_v in CELL_DEVIATIONS_V]
        return {
            "voltage": round(sum(cells), 4),
            "current": round(reading.current_a, 3),
            "temperature": 24.6,
            "cells": cells,
        }

    return values_at


async def start_program(folder: Path, *arguments: object, port: int) -> asyncio.subprocess.Process:
    """Start ``bms-estimator`` with arguments by which it serves a page on ``port``. Wait until the port is open."""
    log = folder / f"{port}.log"
    with log.open("ab") as file:
        process = await asyncio.create_subprocess_exec(
            PROGRAM,
            *map(str, arguments),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.DEVNULL,
            stderr=file,
        )
    async with asyncio.timeout(LONG_S):
        while process.returncode is None:
            with contextlib.suppress(OSError):
                _, writer = await asyncio.open_connection("127.0.0.1", port)
                writer.close()
                return process
            await asyncio.sleep(0.05)
    raise AssertionError(log.read_text())


class Service:
    """Service of one pack, whose board prints text.

    Args:
        folder: Folder of its files and its state.
        broker: Broker to which the service publishes.
        port: Port of its page.
        board: Function of the time since the board's start [s] that returns the values of its next line.
        pack: Section ``[pack]`` without the name, TOML.
        name: Name of the pack.
        more: Further settings, TOML; the first ones belong to ``[state]``.
        rate_hz: Rate of the board's lines and of the publications [Hz].
    """

    def __init__(
        self,
        folder: Path,
        broker: Broker,
        port: int,
        board: Callable[[float], Values],
        *,
        pack: str = PACK,
        name: str = "attic",
        more: str = "",
        rate_hz: float = 10.0,
    ) -> None:
        self.url = f"http://127.0.0.1:{port}/"
        self._folder, self._port, self._board, self._rate_hz = folder, port, board, rate_hz
        self._line = Line(folder / f"board-{name}")
        self._pack = folder / f"{name}.toml"
        self._settings = f"""
[pack]
name = "{name}"
{pack}
[sensor]
port = "{self._line.path}"
protocol = "text"
[publish]
rate_hz = {rate_hz}
[mqtt]
url = "{broker.url}"
commands = ["set_soc"]
[page]
listen = "127.0.0.1:{port}"
[state]
folder = "{folder}"
{more}"""

    async def __aenter__(self) -> Self:
        self._line.plug()
        self._printing = asyncio.create_task(self._print())
        await self.start()
        return self

    async def __aexit__(self, *_: object) -> None:
        if self.process.returncode is None:
            await self.kill()
        self._printing.cancel()
        await asyncio.gather(self._printing, return_exceptions=True)
        self._line.unplug()

    async def start(self, settings: str = "") -> None:
        """Start the service with further settings (TOML), and wait until its page is served."""
        self._pack.write_text(self._settings + settings)
        self.process = await start_program(self._folder, "run", "--no-view", self._pack, port=self._port)

    async def kill(self) -> None:
        self.process.kill()
        await self.process.wait()

    async def _print(self) -> None:
        """Print the board's lines. Lines are lost while the service does not read them."""
        begin_s = asyncio.get_running_loop().time()
        while True:
            time_s = asyncio.get_running_loop().time() - begin_s
            with contextlib.suppress(BlockingIOError, OSError):
                self._line.received()
                self._line.write(json.dumps(self._board(time_s)).encode() + b"\r\n")
            await asyncio.sleep(1.0 / self._rate_hz)
