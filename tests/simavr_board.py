"""The real firmware in simavr: its serial line is a PTY. Needs avr-gcc and libsimavr, else the tests skip and say so."""

import functools
import subprocess
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import Any

import pytest

from bms_estimator.simulation.firmware_board import FirmwareBoard

ROOT = Path(__file__).parents[1]
FIRMWARE = ROOT / "firmware"
ELF = FIRMWARE / "build" / "bms_board.elf"
SIMULATOR = FIRMWARE / "build" / "board_sim"


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
