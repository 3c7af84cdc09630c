"""A first start shows which kernel is being compiled."""

import os
import signal
import subprocess
from pathlib import Path

import pytest

from tests.command_line import PROGRAM
from tests.patience import LONG_S


@pytest.mark.parametrize("command", [pytest.param("demo", marks=pytest.mark.thorough), "replay", "run"])
def test_a_first_start_says_which_kernel_it_compiles_and_can_be_interrupted(command: str, tmp_path: Path) -> None:
    pack, table = tmp_path / "pack.toml", tmp_path / "table.csv"
    pack.write_text('[sensor]\nport = "/dev/none"\n')
    table.write_text("time_s,current_a,voltage_v\n0,0,3.7\n1,0,3.7\n")
    arguments = {
        "demo": [],
        "replay": [table, "--cell", "ncr18650"],
        "run": [pack],
    }
    cold = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    with subprocess.Popen(
        [PROGRAM, command, *arguments[command]], env=cold, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stderr
            first = next(line for line in process.stderr if "compiling kernels" in line)
            process.send_signal(signal.SIGINT)
            rest = process.stderr.read()
            assert process.wait(LONG_S) == 130
        finally:
            process.kill()
    assert "Traceback" not in rest
    assert "compiling kernels, once: 1/" in first
    assert ('"level": "info"' in first) == (command == "run")
