"""The wheel, installed by pipx with packages of the index: the program runs without the checkout."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.deploy.core_environment import build_wheel
from tests.deploy.kernel_cache import fill
from tests.patience import LONG_S

pytestmark = pytest.mark.thorough
Run = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Run:
    """Return a function that runs the program installed by pipx, in the folder that is its first argument."""
    folder = tmp_path_factory.mktemp("pipx")
    environment = folder / "environment"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", environment], check=True)
    python = environment / "bin/python"
    pip = [sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--retries", "0", "pipx"]
    installed = subprocess.run(pip, capture_output=True, text=True, check=False)
    if installed.returncode:
        pytest.skip(f"pipx cannot be installed from the package index: {installed.stderr.splitlines()[-1]}")
    variables = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    places = {f"PIPX_{name}": str(folder / name) for name in ("HOME", "BIN_DIR", "MAN_DIR", "COMPLETION_DIR")}
    command = [python, "-m", "pipx", "install", build_wheel(folder)]
    done = subprocess.run(command, env=variables | places, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    fill(folder / "cache")

    def run_program(cwd: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [folder / "BIN_DIR/bms-estimator", *arguments],
            cwd=cwd,
            env=variables | {"NUMBA_CACHE_DIR": str(folder / "cache")},
            capture_output=True,
            text=True,
            timeout=LONG_S,
            check=False,
        )

    return run_program


def test_demo_runs(run, tmp_path):
    done = run(tmp_path, "demo", "--seconds", "5", "--no-browser")
    assert done.returncode == 0, done.stderr
    assert "frames" in done.stdout.splitlines()[-1]


def test_generic_cell_is_converted_to_a_c_header(run, tmp_path):
    done = run(tmp_path, "cell", "convert", "lfp", "--capacity-ah", "100", "--out", "cell.h")
    assert done.returncode == 0, done.stderr
    assert "#define" in (tmp_path / "cell.h").read_text()
