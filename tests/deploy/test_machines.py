"""Estimates on other CPUs and on arm64 under emulation, beside those of this machine."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from bms_estimator.cli.main import main
from bms_estimator.installation.program_copy import PYTHON, SITE_PACKAGES
from tests.deploy.core_environment import PROJECT
from tests.patience import LONG_S

DEBIAN = {"python3.11": "bookworm", "python3.13": "trixie"}
"""Debian version by its version of Python."""
PROGRAM = ("-P", "-c", "from bms_estimator.cli.main import main; main()")
PACK = (
    '[pack]\ncell = "chen_mora"\ncapacity_ah = 3.3\n[sensor]\nport = "/dev/none"\n[identifier]\nfit_interval_s = 600\n'
)
"""Settings with which the slow fit is adopted within the replay."""
ROUNDING = 1e-6
"""Maximum relative difference of estimates after a fit, whose linear algebra depends on the CPU."""


def replay(folder: Path, python: tuple[str | Path, ...], *options: str, **variables: str) -> str:
    """Replay a discharge with a rest in each five minutes, in this process without ``python``. Return the table of the estimates."""
    loads = [6.6 if k % 30 < 20 else 0.0 for k in range(300)]
    rows = [f"{10 * k},{load},{3.9 - k / 800 - load / 100:.4f}\n" for k, load in enumerate(loads)]
    (folder / "log.csv").write_text("".join(["time_s,current_a,voltage_v\n", *rows]))
    (folder / "pack.toml").write_text(PACK)
    paths = folder / "log.csv", "--pack", folder / "pack.toml", "--out", folder / "estimates.csv", "--force"
    command = ["replay", *map(str, paths), *options]
    if python:
        subprocess.run([*python, *PROGRAM, *command], cwd=folder, env=os.environ | variables, check=True)
    else:
        with pytest.raises(SystemExit, match="0"):
            main(command)
    return (folder / "estimates.csv").read_text()


def assert_equal(folder: Path, *python: str | Path, **variables: str) -> None:
    """Expect the estimates of this machine to the last bit from another Python, and up to rounding with a fit."""
    there = python or (sys.executable,)
    without_fit, *tables = (replay(folder, (), *options) for options in (["--no-pack-model"], []))
    assert replay(folder, there, "--no-pack-model", **variables) == without_fit
    tables.append(replay(folder, there, **variables))
    fitted, other = (np.genfromtxt(table.splitlines(), delimiter=",", names=True) for table in tables)
    for name in fitted.dtype.names:
        np.testing.assert_allclose(other[name], fitted[name], rtol=ROUNDING, err_msg=name)
    assert tables[0] != without_fit  # the fit was adopted


def test_a_cpu_without_newer_instructions_has_the_same_estimates(tmp_path):
    """NumPy and OpenBLAS choose their functions by the CPU. Compiled kernels do not."""
    newer = " ".join(np.show_config(mode="dicts")["SIMD Extensions"]["found"])
    assert_equal(tmp_path, NPY_DISABLE_CPU_FEATURES=newer, OPENBLAS_CORETYPE="Nehalem")


@pytest.mark.thorough
@pytest.mark.timeout(8 * LONG_S)
@pytest.mark.skipif(PYTHON not in DEBIAN, reason=f"no Debian version has {PYTHON}")
def test_the_package_for_arm64_compiles_nothing_and_has_the_same_estimates(tmp_path):
    if not shutil.which("qemu-aarch64") or not shutil.which("mmdebstrap"):
        pytest.skip("qemu-aarch64 or mmdebstrap is not installed (apt install qemu-user mmdebstrap)")
    root, cache = tmp_path / "root", tmp_path / "cache"
    unpack = ["mmdebstrap", "--quiet", "--variant=extract", "--architectures=arm64", f"--include={PYTHON},libstdc++6"]
    subprocess.run([*unpack, DEBIAN[PYTHON], root], check=True)
    build = [sys.executable, PROJECT / "deploy/debian/build.py", tmp_path / "deb", "--arm64", "--compression=none"]
    subprocess.run(build, check=True)
    packages = tmp_path / "deb/root/usr/lib/bms-estimator" / SITE_PACKAGES
    python = ("qemu-aarch64", "-L", root, root / "usr/bin" / PYTHON)
    assert_equal(tmp_path, *python, PYTHONPATH=str(packages), NUMBA_CACHE_DIR=str(cache))
    assert not list(cache.rglob("*.nbc"))
