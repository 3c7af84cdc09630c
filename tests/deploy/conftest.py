"""Fixtures for the deployed files and the programs that check them."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from bms_estimator.installation.install import FILES


@pytest.fixture
def find_program() -> Callable[[str], str]:
    """Return a function that takes the names of a program and of its Debian package, and returns the program's path.

    It skips the test if the program is not installed.
    """

    def find(name: str, package: str) -> str:
        path = shutil.which(name, path=f"{os.environ['PATH']}:/usr/sbin:/sbin")
        if path is None:
            pytest.skip(f"{name} is not installed (apt install {package})")
        return path

    return find


@pytest.fixture(scope="session")
def systemd_nspawn() -> str:
    """Return the path of the program that boots containers. It skips the test where it cannot be used."""
    path = "/usr/bin/systemd-nspawn"
    if not os.access(path, os.X_OK):
        pytest.skip("systemd-nspawn is not installed (apt install systemd-container)")
    if os.geteuid() != 0:
        pytest.skip("only root can boot a container")
    return path


@pytest.fixture
def deploy() -> Path:
    """Return the folder with the files to deploy."""
    return Path(__file__).parents[2] / "deploy"


@pytest.fixture
def unit_text() -> str:
    """Return the text of the service's unit."""
    return (FILES / "bms-estimator.service").read_text(encoding="utf-8")
