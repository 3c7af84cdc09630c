"""Environment with the wheel and the packages of requirements-core.lock, and nothing else of the tests' environment."""

import importlib.metadata
import os
import re
import subprocess
import sys
import sysconfig
import zipfile
from collections.abc import Sequence
from pathlib import Path

from tests.patience import LONG_S

PROJECT = Path(__file__).parents[2]
VARIABLES = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
"""Environment variables of a program that must not import the checkout."""


def core_packages() -> set[str]:
    """Return the names of the packages in requirements-core.lock that this platform needs."""
    lines = re.findall(
        r"(?m)^([\w-]+)==\S+( ; sys_platform == 'win32')?", (PROJECT / "requirements-core.lock").read_text()
    )
    return {name for name, marker in lines if not marker}


def installed_files(package: str) -> list[Path]:
    """Return the files of an installed package, relative to the folder of packages."""
    files = [Path(file) for file in importlib.metadata.files(package) or ()]
    return [file for file in files if file.suffix != ".pyc"]


def make_core_environment(folder: Path) -> Path:
    """Make the environment in ``folder`` and return the folder of its packages."""
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True)
    packages = Path(sysconfig.get_path("purelib", vars={"base": str(folder)}))
    source = Path(sysconfig.get_path("purelib"))
    for file in {file for package in core_packages() for file in installed_files(package)}:
        place = packages / file  # scripts have paths such as ../../../bin/name
        place.parent.mkdir(parents=True, exist_ok=True)
        if not place.exists():
            place.symlink_to(source / file)
    with zipfile.ZipFile(build_wheel(folder)) as wheel:
        wheel.extractall(packages)
    return packages


def build_wheel(folder: Path, project: Path = PROJECT) -> Path:
    """Build the wheel of ``project`` in ``folder`` and return its path."""
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", folder]
    subprocess.run(command, cwd=project, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    return wheel


def run_program(command: Sequence[str | Path], folder: Path, kernel_cache: Path) -> subprocess.CompletedProcess[str]:
    """Run a program of another environment in ``folder``, without access to the checkout."""
    return subprocess.run(
        command,
        cwd=folder,
        env=VARIABLES | {"NUMBA_CACHE_DIR": str(kernel_cache)},
        capture_output=True,
        text=True,
        timeout=LONG_S,
        check=False,
    )
