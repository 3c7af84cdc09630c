"""The wheel, installed by pipx with packages of the index: the program runs without the checkout."""

import subprocess
import sys

import pytest

from tests.deploy.core_environment import VARIABLES, build_wheel, run_program
from tests.deploy.kernel_cache import fill

pytestmark = pytest.mark.thorough


@pytest.fixture(scope="module")
def pipx_folder(tmp_path_factory):
    """Return a folder with the program in ``BIN_DIR``, installed by pipx, and a kernel cache in ``cache``."""
    folder = tmp_path_factory.mktemp("pipx")
    environment = folder / "environment"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", environment], check=True)
    python = environment / "bin/python"
    pip = [sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--retries", "0", "pipx"]
    installed = subprocess.run(pip, capture_output=True, text=True, check=False)
    if installed.returncode:
        pytest.skip(f"pipx cannot be installed from the package index: {installed.stderr.splitlines()[-1]}")
    places = {f"PIPX_{name}": str(folder / name) for name in ("HOME", "BIN_DIR", "MAN_DIR", "COMPLETION_DIR")}
    command = [python, "-m", "pipx", "install", build_wheel(folder)]
    done = subprocess.run(command, env=VARIABLES | places, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    fill(folder / "cache")
    return folder


def run(pipx_folder, folder, *arguments):
    """Run the installed program in ``folder``."""
    return run_program([pipx_folder / "BIN_DIR/bms-estimator", *arguments], folder, pipx_folder / "cache")


def test_demo_runs(pipx_folder, tmp_path):
    done = run(pipx_folder, tmp_path, "demo", "--seconds", "5", "--no-browser")
    assert done.returncode == 0, done.stderr
    assert "frames" in done.stdout.splitlines()[-1]


def test_generic_cell_is_converted_to_a_c_header(pipx_folder, tmp_path):
    done = run(pipx_folder, tmp_path, "cell", "convert", "lfp", "--capacity-ah", "100", "--out", "cell.h")
    assert done.returncode == 0, done.stderr
    assert "#define" in (tmp_path / "cell.h").read_text()
