"""Real firmware in simavr, with a PTY as its serial line.

It needs avr-gcc and libsimavr. Without them the tests are skipped with the reason.
"""

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
"""Rate of the readings of the pack model [Hz]. Each reading holds until the next."""
LINES_AT_ONCE = 50
"""Number of readings that are written to the simulator at a time."""
PIPE_BYTES = 4096
"""Size of the pipe to the simulator. Each 4 kB of buffered readings delay the reaction of the pack by about 2.5 s."""
STOP_S = 5.0
"""Time for the simulator to end after SIGTERM, before it is killed [s]."""


class FirmwareBoard:
    """Process of ``firmware/build/board_sim``. The board powers up when its line is first opened.

    Args:
        build: Folder of the built firmware.
        readings: Pack at the pins of the board: a function of time [s], or a file with
            ``time_s,current_a,voltage_v[,temperature_c]``. Each line holds until the next.
        speed: Board seconds per second; ``math.inf``: as fast as the host reads.
        avcc_mv: Supply voltage, which is the reference of the ADC [mV].
        noise_lsb: Noise of the ADC [steps].
        loop: True: a file is repeated after its last line; False: the last line holds.
        relay: True if the load is switched off while the relay pin is high.
        seed: Seed of the noise.

    Attributes:
        path: Path of the pseudo-terminal.
        exit_code: Exit code of the ended simulator; negative if it was killed.
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
        self._readings, self._lines_written = readings, 0
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

    def __enter__(self) -> Self:
        """Start the simulator.

        Raises:
            UserError: The simulator does not start.
        """
        # With a new session, Ctrl-C does not reach the simulator, which this object ends.
        self._process = subprocess.Popen(
            self._command,
            bufsize=0,
            pipesize=PIPE_BYTES,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
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
        """Write the values of the function ``readings`` until the simulator ends. The pipe blocks while it is full."""
        while await asyncio.to_thread(self._feed):
            pass

    def _feed(self) -> bool:
        """Write the next values of the function ``readings``. Return False if the simulator accepts no more."""
        if isinstance(self._readings, Path):
            return False
        lines = b"".join(self._line(self._readings) for _ in range(LINES_AT_ONCE))
        assert self._process.stdin
        try:
            self._process.stdin.write(lines)
        except BrokenPipeError:
            return False
        return True

    def _line(self, pack: Callable[[float], Reading]) -> bytes:
        self._lines_written += 1
        time_s = self._lines_written / READINGS_HZ
        return b"%.4f,%.6f,%.6f,%.2f\n" % (time_s, *pack(time_s))


@functools.cache
def build_firmware() -> str:
    """Build firmware and simulator once. Return the reason if that is impossible, otherwise an empty text."""
    if subprocess.run([ROOT / ".ci" / "can-simulate"], check=False).returncode != 0:
        return "no simavr or no compiler for the AVR here: make apt"
    subprocess.run(["make", "--silent", "-C", FIRMWARE, "all", "sim"], check=True, stdout=subprocess.DEVNULL)
    return ""


@pytest.fixture(scope="session")
def firmware() -> None:
    """Skip the test if the firmware cannot be built or simulated."""
    if reason := build_firmware():
        pytest.skip(reason)


def write_readings(path: Path, readings: Iterable[tuple[float, ...]]) -> Path:
    """Write a file of (time_s, current_a, voltage_v[, temperature_c]) for the simulator, and return its path."""
    with path.open("w") as file:
        file.write("time_s,current_a,voltage_v,temperature_c\n")
        for reading in readings:
            file.write(",".join(f"{value:.9g}" for value in reading) + "\n")
    return path


class SimavrBoard(FirmwareBoard):
    """Firmware in simavr with readings from a file. Its exit asserts that the simulator ended without an error."""

    def __init__(self, readings: Path, **options: Any) -> None:
        super().__init__(FIRMWARE / "build", readings, **options)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        super().__exit__(kind, error, trace)
        assert self.exit_code == 0, "the simulator did not end cleanly"
