"""Line about the compilation of kernels at a first start."""

import os
import re
import signal
import subprocess
from pathlib import Path

import pytest

from bms_estimator.cli.options.progress_bar import COMPILE_LABEL, COMPILE_TEXT
from tests.command_line import PROGRAM
from tests.patience import LONG_S
from tests.pseudo_terminal import PseudoTerminal, accept_interrupts


@pytest.mark.parametrize(
    "command", [*(pytest.param(name, marks=pytest.mark.thorough) for name in ("demo", "replay")), "run"]
)
def test_first_start_reports_the_compilation_and_can_be_interrupted(command: str, tmp_path: Path) -> None:
    pack, table = tmp_path / "pack.toml", tmp_path / "table.csv"
    pack.write_text('[sensor]\nport = "/dev/none"\n')
    table.write_text("time_s,current_a,voltage_v\n0,0,3.7\n1,0,3.7\n")
    arguments = {
        "demo": [],
        "replay": [table, "--cell", "ncr18650"],
        "run": [pack],
    }
    empty_cache = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    with subprocess.Popen(
        [PROGRAM, command, *arguments[command]],
        env=empty_cache,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=accept_interrupts,  # noqa: PLW1509 - it only sets a signal handler
    ) as process:
        try:
            assert process.stderr
            first = next(line for line in process.stderr if COMPILE_TEXT in line)
            process.send_signal(signal.SIGINT)
            rest = process.stderr.read()
            assert process.wait(LONG_S) == 130
        finally:
            process.kill()
    assert "Traceback" not in rest
    assert ('"level": "info"' in first) == (command == "run")  # a service logs JSON to a pipe


def test_a_terminal_shows_the_number_of_kernels_that_are_compiled_and_the_time_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    table = tmp_path / "table.csv"
    table.write_text("time_s,current_a,voltage_v\n0,0,3.7\n1,0,3.7\n")
    with PseudoTerminal("replay", str(table), "--cell", "ncr18650") as terminal:
        terminal.until(
            lambda: re.search(rf"{COMPILE_LABEL}: [1-9]\d* of \d+ .*\d:\d\d:\d\d", terminal.output) is not None
        )
        assert COMPILE_TEXT in terminal.output
