"""The demo's board: the firmware in its simulator, or a simulation in Python."""

import asyncio
from collections.abc import AsyncIterator, Coroutine
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, NamedTuple

import bms_estimator
from bms_estimator.demo.true_soc import TrueSoc
from bms_estimator.model.errors import UserError
from bms_estimator.simulation.firmware_board import FirmwareBoard
from bms_estimator.simulation.virtual_board import VirtualBoard

FIRMWARE_BUILD = Path(bms_estimator.__file__).parents[1] / "firmware" / "build"


class Board(NamedTuple):
    """A board that runs."""

    name: str
    path: str
    """Path of its pseudo-terminal."""


def find_build(given: Path | None) -> Path | None:
    """Folder of the built firmware; None if it is not built and was not requested.

    Raises:
        UserError: Nothing is built in the folder that was given.
    """
    folder = FIRMWARE_BUILD if given is None else given
    if FirmwareBoard.is_built(folder):
        return folder
    if given is not None:
        raise UserError(f"--firmware {given}: no built firmware and simulator there; make firmware, or --python-board")
    return None


@asynccontextmanager
async def running_board(build: Path | None, truth: TrueSoc, *, rate_hz: int, speed: float) -> AsyncIterator[Board]:
    """Run the firmware in its simulator if ``build`` holds it, else the board in Python.

    Args:
        build: Folder of the built firmware.
        truth: The simulated pack.
        rate_hz: Samples per second of its time.
        speed: Its seconds per second.
    """
    if build is None:
        with VirtualBoard(truth, rate_hz=rate_hz, speed=speed) as virtual:
            async with _running(virtual.run_for_host()):
                yield Board("board in Python", virtual.path)
    else:
        with FirmwareBoard(build, truth, speed=speed) as simulated:
            async with _running(simulated.run()):
                yield Board("firmware in simavr", simulated.path)


@asynccontextmanager
async def _running(work: Coroutine[Any, Any, None]) -> AsyncIterator[None]:
    task = asyncio.create_task(work)
    try:
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
