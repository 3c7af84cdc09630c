"""The real firmware in simavr: its serial line is a PTY. Needs avr-gcc and libsimavr, else the tests skip and say so."""

import asyncio
import functools
import math
import subprocess
from collections.abc import Callable, Iterable
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import pytest

from bms_estimator.model.errors import UserError
from bms_estimator.simulation.virtual_adc import Reading

ROOT = Path(__file__).parents[1]
FIRMWARE = ROOT / "firmware"
ELF = FIRMWARE / "build" / "bms_board.elf"
SIMULATOR = FIRMWARE / "build" / "board_sim"


READINGS_HZ = 50
"""Rate of readings of the pack model [Hz]; each is held until the next."""
LINES_AT_ONCE = 50
STOP_S = 5.0


class FirmwareBoard:
    """``firmware/build/board_sim`` while the context lasts. It powers up when its line is first opened.

    Args:
        build: Folder of the built firmware.
        readings: Signal at its pins: a function of time [s], or a file with
            ``time_s,current_a,voltage_v[,temperature_c]``, each line held until the next.
        speed: Board seconds per second; ``math.inf``: as fast as the host reads.
        avcc_mv: Supply and reference of its converter.
        noise_lsb: Noise of its converter [steps].
        loop: Begin a file again after its last line; else that is held.
        relay: Whether its relay pin cuts the load while it is high.
        seed: Of the noise.

    Attributes:
        path: Of the pseudo-terminal.
        exit_code: Of the simulator, once it has ended; below zero where it had to be killed.
    """

    def __init__(
        self,
        build: Path,
        readings: Path | Callable[[float], Reading],
        *,
        speed: float = 1.0,
        avcc_mv: int = 5000,
        noise_lsb: float = 0.5,
        loop: bool = False,
        relay: bool = False,
        seed: int = 1,
    ) -> None:
        self._readings, self._fed = readings, 0
        self._command = [
            *(str(build / "board_sim"), str(build / "bms_board.elf")),
            *("--readings", str(readings) if isinstance(readings, Path) else "-"),
            *("--speed", "inf" if math.isinf(speed) else str(speed), "--avcc-mv", str(avcc_mv)),
            *("--noise-lsb", str(noise_lsb), "--seed", str(seed)),
            *(["--loop"] if loop else []),
            *(["--relay"] if relay else []),
        ]
        self.path = ""
        self.exit_code: int | None = None

    @staticmethod
    def is_built(build: Path) -> bool:
        """Return True if ``build`` holds the firmware and its simulator."""
        return all((build / name).is_file() for name in ("board_sim", "bms_board.elf"))

    def __enter__(self) -> Self:
        """Start the simulator.

        Raises:
            UserError: It does not run.
        """
        # a session of its own: Ctrl-C is for the program that ends it
        self._process = subprocess.Popen(
            self._command, bufsize=0, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
        )
        assert self._process.stdout
        self._feed()
        self.path = self._process.stdout.readline().decode().strip()
        if not self.path:
            self.__exit__(None, None, None)
            raise UserError(f"{self._command[0]} does not start; rebuild it: make firmware")
        return self

    def __exit__(self, *_: object) -> None:
        """End the simulator."""
        self._process.terminate()
        try:
            self._process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
        self.exit_code = self._process.wait()
        assert self._process.stdin
        assert self._process.stdout
        self._process.stdin.close()
        self._process.stdout.close()

    async def run(self) -> None:
        """Have a signal's readings at its pins for as long as it runs: the pipe takes them as it needs them."""
        while await asyncio.to_thread(self._feed):
            pass

    def _feed(self) -> bool:
        """Give the next readings of a signal. Returns whether the simulator takes more."""
        if isinstance(self._readings, Path):
            return False
        lines = b"".join(self._line(self._readings) for _ in range(LINES_AT_ONCE))
        assert self._process.stdin
        try:
            self._process.stdin.write(lines)
        except BrokenPipeError:
            return False
        return True

    def _line(self, signal: Callable[[float], Reading]) -> bytes:
        self._fed += 1
        time_s = self._fed / READINGS_HZ
        return b"%.4f,%.6f,%.6f,%.2f\n" % (time_s, *signal(time_s))


@functools.cache
def _built() -> str:
    """Build firmware and simulator once. Returns why that is impossible, or nothing."""
    if subprocess.run([ROOT / ".ci" / "can-simulate"], check=False).returncode != 0:
        return "no simavr or no compiler for the AVR here: make apt"
    subprocess.run(["make", "--silent", "-C", FIRMWARE, "all", "sim"], check=True, stdout=subprocess.DEVNULL)
    return ""


@pytest.fixture(scope="session")
def firmware() -> None:
    """Skips where the firmware cannot be built or simulated."""
    if reason := _built():
        pytest.skip(reason)


def write_readings(path: Path, readings: Iterable[tuple[float, ...]]) -> Path:
    """A file of (time_s, current_a, voltage_v[, temperature_c]) for the simulator."""
    with path.open("w") as file:
        file.write("time_s,current_a,voltage_v,temperature_c\n")
        for reading in readings:
            file.write(",".join(f"{value:.9g}" for value in reading) + "\n")
    return path


class SimavrBoard(FirmwareBoard):
    """The firmware's ELF in simavr, fed from a file of readings; leaving it asserts the clean end."""

    def __init__(self, readings: Path, **options: Any) -> None:
        super().__init__(FIRMWARE / "build", readings, **options)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        super().__exit__(kind, error, trace)
        assert self.exit_code == 0, "the simulator did not end cleanly"
