"""The wheel, installed by pipx with packages of the index: the program runs without the checkout."""

import subprocess
import sys

import pytest

from tests.deploy.core_environment import VARIABLES, build_wheel, run_program
from tests.deploy.kernel_cache import fill


@pytest.mark.thorough
def test_demo_runs(tmp_path):
    environment = tmp_path / "environment"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", environment], check=True)
    python = environment / "bin/python"
    pip = [sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--retries", "0", "pipx"]
    installed = subprocess.run(pip, capture_output=True, text=True, check=False)
    if installed.returncode:
        pytest.skip(f"pipx cannot be installed from the package index: {installed.stderr.splitlines()[-1]}")
    places = {f"PIPX_{name}": str(tmp_path / name) for name in ("HOME", "BIN_DIR", "MAN_DIR", "COMPLETION_DIR")}
    command = [python, "-m", "pipx", "install", build_wheel(tmp_path)]
    done = subprocess.run(command, env=VARIABLES | places, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    fill(tmp_path / "cache")
    program = [tmp_path / "BIN_DIR/bms-estimator", "demo", "--seconds", "5", "--no-browser"]
    done = run_program(program, tmp_path, tmp_path / "cache")
    assert done.returncode == 0, done.stderr
    assert "frames" in done.stdout.splitlines()[-1]
