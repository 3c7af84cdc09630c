"""Boards that measure the simulated pack: the virtual board in Python, and the firmware in simavr."""

import asyncio
import contextlib
import math
from collections.abc import AsyncIterator
from contextlib import AbstractAsyncContextManager
from typing import Protocol

from bms_estimator.process.runtime import end_tasks
from bms_estimator.simulation.virtual_adc import BoardParts
from bms_estimator.simulation.virtual_board import VirtualBoard
from tests.end_to_end.lfp_pack import LfpPack
from tests.simavr_board import FIRMWARE, FirmwareBoard

PARTS = BoardParts(divider=3.23, current_zero=0.503, bandgap_v=1.08)
"""True properties of the virtual board. The user enters the nominal divider, 3.2."""
SLICE_S = 10.0
"""Duration that the virtual board simulates before it waits for real time [s]."""


class Board(Protocol):
    """Board whose speed a test chooses.

    Attributes:
        path: Path of its pseudo-terminal.
    """

    path: str

    def running(self) -> AbstractAsyncContextManager[None]:
        """Run the board for commands that expect real time."""

    def accelerated(self, speed: float) -> AbstractAsyncContextManager[None]:
        """Run the board faster than real time, at most at ``speed``."""


class PythonBoard:
    """Virtual board.

    Args:
        board: The opened board.
    """

    def __init__(self, board: VirtualBoard) -> None:
        self._board, self.path = board, board.path

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Run the board in real time."""
        self._board.speed = 1.0
        task = asyncio.create_task(self._board.run())
        try:
            yield
        finally:
            await end_tasks(task)

    @contextlib.asynccontextmanager
    async def accelerated(self, speed: float) -> AsyncIterator[None]:
        """Run the board faster than real time. It waits for a host that reads late, so that no sample is lost."""
        self._board.speed = math.inf  # the host's reads set the pace within a slice
        task = asyncio.create_task(self._run_slices(speed))
        try:
            yield
        finally:
            await end_tasks(task)

    async def _run_slices(self, speed: float) -> None:
        loop = asyncio.get_running_loop()
        while True:
            due_s = loop.time() + SLICE_S / speed
            await self._board.run(SLICE_S)
            await asyncio.sleep(max(due_s - loop.time(), 0.0))


class SimulatedFirmware:
    """Firmware in simavr. It always runs as fast as possible, which is 12 to 15 times real time.

    Args:
        board: The opened board.
    """

    def __init__(self, board: FirmwareBoard) -> None:
        self.path = board.path

    def running(self) -> AbstractAsyncContextManager[None]:
        """Do nothing, because the board always runs."""
        return contextlib.nullcontext()

    def accelerated(self, speed: float) -> AbstractAsyncContextManager[None]:  # noqa: ARG002 - simavr has no speed above its own
        """Do nothing, because the board always runs."""
        return contextlib.nullcontext()


@contextlib.asynccontextmanager
async def open_board(kind: str, pack: LfpPack) -> AsyncIterator[Board]:
    """Yield a board of a kind, ``python`` or ``simavr``, that measures the pack."""
    if kind == "python":
        with VirtualBoard(pack, parts=PARTS) as board:
            yield PythonBoard(board)
        return
    with FirmwareBoard(FIRMWARE / "build", pack, speed=math.inf) as firmware:
        task = asyncio.create_task(firmware.run())
        try:
            yield SimulatedFirmware(firmware)
        finally:
            await end_tasks(task)
