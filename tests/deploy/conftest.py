"""Fixtures for the deployed files and the programs that check them."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

DEPLOY = Path(__file__).parents[2] / "deploy"


@pytest.fixture
def program() -> Callable[[str], str]:
    """Return a function that returns the path of a program. Without the program it skips the test and names the Debian package."""

    def find(name: str, package: str) -> str:
        path = shutil.which(name, path=f"{os.environ['PATH']}:/usr/sbin:/sbin")
        if path is None:
            pytest.skip(f"{name} is not installed (apt install {package})")
        return path

    return find


@pytest.fixture
def deploy() -> Path:
    return DEPLOY
