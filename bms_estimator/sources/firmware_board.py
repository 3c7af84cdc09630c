"""The board's own firmware in the simulator simavr, with a simulated pack at its pins; its serial line is a PTY."""

import asyncio
import contextlib
from pathlib import Path
from types import TracebackType
from typing import Self

from bms_estimator.model.errors import UserError
from bms_estimator.sources.simulated_pack import SimulatedPack

READINGS_HZ = 50
"""The pack's readings; each is held until the next."""
LINES_AT_ONCE = 50
STOP_S = 5.0


class FirmwareBoard:
    """``firmware/build/board_sim`` while the context lasts. It powers up when its line is first opened.

    Args:
        build: Folder of the built firmware.
        pack: What is at its pins.

    Attributes:
        path: Of the pseudo-terminal.
    """

    def __init__(self, build: Path, pack: SimulatedPack) -> None:
        self._command = (str(build / "board_sim"), str(build / "bms_board.elf"), "--readings", "-")
        self._pack = pack
        self.path = ""

    @staticmethod
    def is_built(build: Path) -> bool:
        """Whether ``build`` holds the firmware and its simulator."""
        return all((build / name).is_file() for name in ("board_sim", "bms_board.elf"))

    async def __aenter__(self) -> Self:
        """Start the simulator.

        Raises:
            UserError: It does not run.
        """
        pipe = asyncio.subprocess.PIPE
        # a session of its own: Ctrl-C is for the program that ends it
        self._process = await asyncio.create_subprocess_exec(
            *self._command, stdin=pipe, stdout=pipe, start_new_session=True
        )
        assert self._process.stdin  # noqa: S101
        assert self._process.stdout  # noqa: S101
        self._process.stdin.write(b"".join(self._readings()))
        self.path = (await self._process.stdout.readline()).decode().strip()
        if not self.path:
            raise UserError(f"{self._command[0]} does not start; build it anew: make firmware")
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the simulator."""
        with contextlib.suppress(ProcessLookupError):
            self._process.terminate()
        try:
            await asyncio.wait_for(self._process.wait(), STOP_S)
        except TimeoutError:
            self._process.kill()

    async def run(self) -> None:
        """Have the pack's readings at its pins for as long as it runs: the pipe takes them as it needs them."""
        assert self._process.stdin  # noqa: S101
        while True:
            self._process.stdin.writelines(self._readings())
            await self._process.stdin.drain()

    def _readings(self) -> list[bytes]:
        """Lines of the next readings."""
        lines = []
        for _ in range(LINES_AT_ONCE):
            now = self._pack(self._pack.time_s + 1.0 / READINGS_HZ)
            lines.append(
                b"%.4f,%.6f,%.6f,%.2f\n" % (self._pack.time_s, now.current_a, now.voltage_v, now.temperature_c)
            )
        return lines
