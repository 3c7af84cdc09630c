"""The real firmware in simavr: its serial line is a PTY. Needs avr-gcc and libsimavr, else the tests skip and say so."""

import functools
import math
import subprocess
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import Self

import pytest

ROOT = Path(__file__).parents[1]
FIRMWARE = ROOT / "firmware"
ELF = FIRMWARE / "build" / "bms_board.elf"
SIMULATOR = FIRMWARE / "build" / "board_sim"
STOP_S = 10.0


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


class SimavrBoard:
    """The firmware's ELF in simavr, fed from a file of readings. It powers up when its line is first opened.

    Args:
        readings: File with time_s,current_a,voltage_v[,temperature_c], each line held until the next.
        speed: Board seconds per second; ``math.inf``: as fast as the host reads.
        avcc_mv: Supply and reference of its converter.
        noise_lsb: Noise of its converter [steps].
        loop: Begin again after the last reading; else it is held.
        seed: Of the noise.
    """

    def __init__(
        self,
        readings: Path,
        *,
        speed: float = 1.0,
        avcc_mv: int = 5000,
        noise_lsb: float = 0.5,
        loop: bool = False,
        seed: int = 1,
    ) -> None:
        self._command = [
            *(str(SIMULATOR), str(ELF), "--readings", str(readings)),
            *("--speed", "inf" if math.isinf(speed) else str(speed), "--avcc-mv", str(avcc_mv)),
            *("--noise-lsb", str(noise_lsb), "--seed", str(seed)),
            *(["--loop"] if loop else []),
        ]
        self.path = ""
        """Of the PTY."""

    def __enter__(self) -> Self:
        self._process = subprocess.Popen(self._command, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout
        self.path = self._process.stdout.readline().strip()
        assert self.path, "the simulator did not start"
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.terminate()
        assert self._process.stdout
        self._process.stdout.close()
        assert self._process.wait(STOP_S) == 0, "the simulator did not end cleanly"
