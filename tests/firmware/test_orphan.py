"""A simulated board does not outlive the program that started it, however that ends."""

import os
import subprocess
import sys
import time
from pathlib import Path

from tests.patience import LONG_S
from tests.simavr_board import ELF, SIMULATOR, write_readings

# Pid and terminal go to two pipes: on one, either line may come first.
START = """
import subprocess, sys
board = subprocess.Popen(sys.argv[1:], stdout=sys.stderr)
print(board.pid, flush=True)
board.wait()
"""


def test_simulator_ends_when_its_parent_is_killed(firmware: None, tmp_path: Path) -> None:
    readings = write_readings(tmp_path / "readings.csv", [(0.0, 0.1, 3.8)])
    command = [sys.executable, "-c", START, SIMULATOR, ELF, "--readings", readings]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, text=True, **pipes) as parent:
        assert parent.stdout
        assert parent.stderr
        try:
            board = int(parent.stdout.readline())
            assert parent.stderr.readline().startswith("/dev/pts/")
        finally:
            parent.kill()
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
