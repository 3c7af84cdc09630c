"""Files to deploy, and the programs that check them."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

DEPLOY = Path(__file__).parents[2] / "deploy"


@pytest.fixture
def program() -> Callable[[str], str]:
    """Path of a program, or a skip that names the Debian package it is in."""

    def find(name: str, package: str) -> str:
        path = shutil.which(name, path=f"{os.environ['PATH']}:/usr/sbin:/sbin")
        if path is None:
            pytest.skip(f"{name} is not installed (apt install {package})")
        return path

    return find


@pytest.fixture
def deploy() -> Path:
    return DEPLOY
