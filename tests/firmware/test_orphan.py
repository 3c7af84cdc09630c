"""A simulated board does not outlive the program that started it, however that ends."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from tests.simavr_board import ELF, SIMULATOR, write_readings

LONG_S = 20.0
START = "import subprocess, sys; p = subprocess.Popen(sys.argv[1:]); print(p.pid, flush=True); p.wait()"


def test_it_ends_with_a_parent_that_is_killed(firmware: None, tmp_path: Path) -> None:
    readings = write_readings(tmp_path / "readings.csv", [(0.0, 0.1, 3.8)])
    command = [sys.executable, "-c", START, SIMULATOR, ELF, "--readings", readings]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout
        board = int(parent.stdout.readline())
        assert parent.stdout.readline().startswith("/dev/pts/")
        parent.send_signal(signal.SIGKILL)
    deadline = time.monotonic() + LONG_S
    while alive(board):
        assert time.monotonic() < deadline
        time.sleep(0.02)


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return "Z" not in Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
