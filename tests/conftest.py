"""Fixtures that every test may use."""

import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from bms_estimator.service.kernel_warm_up import load_kernels
from tests.full_disk import disk_without_files, full_disk
from tests.mosquitto import broker
from tests.serial_line import line
from tests.simavr_board import firmware

__all__ = ["broker", "disk_without_files", "firmware", "full_disk", "line"]

# no deadline: compilation and shared machines make times meaningless
settings.register_profile("short", deadline=None, derandomize=True, database=None)
settings.register_profile(
    "long", deadline=None, max_examples=int(os.environ.get("INPUTS", "20000")), suppress_health_check=list(HealthCheck)
)
settings.load_profile("short")

DATA = Path(__file__).parent / "data"
SHARED_DATA = Path(__file__).parents[2] / "shared" / "data"


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile kernels before each worker would, and before a test reads a program's output about it."""
    if not hasattr(session.config, "workerinput"):
        load_kernels()


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Return the folder of the real captures, or skip with the searched path."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"real captures are absent: {SHARED_DATA} does not exist")
    return SHARED_DATA


@pytest.fixture(scope="session")
def data() -> Path:
    """Return the folder of the captures of the tests."""
    return DATA


@pytest.fixture(autouse=True)
def state_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Set the state folder of programs: neither the user's home nor another test's folder."""
    folder = tmp_path / "state-home"
    monkeypatch.setenv("XDG_STATE_HOME", str(folder))
    return folder
