"""Where the files to deploy are, and how to find the programs that judge them."""

import os
import shutil
import socket
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
def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def deploy() -> Path:
    return DEPLOY
