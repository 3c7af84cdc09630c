"""Line about the compilation of kernels at a first start."""

import os
import re
import signal
import subprocess
from pathlib import Path

import pytest

from bms_estimator.cli.options.compile_progress import COMPILE_LABEL, COMPILE_TEXT, show_compile_progress
from bms_estimator.kernels.cell_model import chen_mora
from bms_estimator.numba_cache import count_cached_kernels, count_kernels, njit
from bms_estimator.service.kernel_warm_up import load_kernels
from tests.command_line import PROGRAM
from tests.patience import LONG_S
from tests.pseudo_terminal import PseudoTerminal


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


def test_line_is_printed_once_and_only_if_a_kernel_is_compiled() -> None:
    lines: list[str] = []
    kernel = njit()(chen_mora.min_stable_exponent.py_func)  # not in the cache
    with show_compile_progress(lines.append):
        kernel(0.5, 1.0, 2.0)
        njit()(chen_mora.delta.py_func)(0.5, 1.0, 2.0)
    assert lines == [COMPILE_TEXT]
    with show_compile_progress(lines.append):
        kernel(0.6, 1.0, 2.0)
    assert lines == [COMPILE_TEXT]


def test_a_terminal_shows_the_fraction_of_the_kernels_that_are_compiled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    table = tmp_path / "table.csv"
    table.write_text("time_s,current_a,voltage_v\n0,0,3.7\n1,0,3.7\n")
    with PseudoTerminal("replay", str(table), "--cell", "ncr18650") as terminal:
        terminal.until(lambda: re.search(rf"{re.escape(COMPILE_LABEL)}.* [1-9]\d?%", terminal.output) is not None)


def test_a_compiled_kernel_counts_as_cached_and_all_kernels_are_counted() -> None:
    load_kernels()
    assert count_kernels() > 100
    assert 0.8 * count_kernels() < count_cached_kernels()
