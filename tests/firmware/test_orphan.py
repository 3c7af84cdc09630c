"""End of a simulated board when the program that started it is killed."""

import os
import subprocess
import sys
import time
from pathlib import Path

from tests.patience import LONG_S
from tests.simavr_board import ELF, SIMULATOR, write_readings

# The PID and the path of the terminal are written to two pipes, because on one pipe their order would be random.
PARENT_SCRIPT = """
import subprocess, sys
board = subprocess.Popen(sys.argv[1:], stdout=sys.stderr)
print(board.pid, flush=True)
board.wait()
"""


def test_simulator_ends_when_its_parent_is_killed(firmware: None, tmp_path: Path) -> None:
    readings = write_readings(tmp_path / "readings.csv", [(0.0, 0.1, 3.8)])
    command = [sys.executable, "-c", PARENT_SCRIPT, SIMULATOR, ELF, "--readings", readings]
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
    while is_alive(board):
        assert time.monotonic() < deadline
        time.sleep(0.02)


def is_alive(pid: int) -> bool:
    """Return True if the process exists and is no zombie."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return "Z" not in Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
