"""Fixtures that every test may use."""

import gc
import itertools
import os
import sys
from collections.abc import Generator
from pathlib import Path

import pytest
import structlog
from hypothesis import HealthCheck, settings

from bms_estimator.forecast import projection
from bms_estimator.reports import report_parts
from bms_estimator.service.kernel_warm_up import load_kernels
from tests.full_disk import disk_without_files, full_disk
from tests.mosquitto import broker
from tests.serial_line import line
from tests.simavr_board import firmware

__all__ = ["broker", "disk_without_files", "firmware", "full_disk", "line"]

# There is no deadline, because compilation and other processes make times meaningless.
settings.register_profile("short", deadline=None, derandomize=True, database=None)
settings.register_profile(
    "long",
    deadline=None,
    max_examples=int(os.environ.get("HYPOTHESIS_MAX_EXAMPLES", "20000")),
    suppress_health_check=list(HealthCheck),
)
settings.load_profile("short")

# OpenBLAS threads wait for each other in busy loops. With several workers that takes three times the CPU time of one
# thread. Workers and the programs that tests start inherit the environment.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# The default renderer prints the local variables of each frame of a logged exception, which takes up to a second.
structlog.configure(
    processors=[
        *structlog.get_config()["processors"][:-1],
        structlog.dev.ConsoleRenderer(exception_formatter=structlog.dev.plain_traceback),
    ]
)
# Without byte code, each worker and each started program compiles all modules again.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

LONG_FILES = (
    "tests/home_assistant/test_home_assistant.py",
    "tests/page/test_browser.py",
    "tests/service/test_alarm_hooks.py",
    "tests/cli/settings/test_new.py",
    "tests/fleet/worker/test_worker.py",
    "tests/fleet/server/test_serve.py",
    "tests/service/test_alarm_state.py",
    "tests/calibration/elements/test_identify.py",
    "tests/cli/captures/test_verdicts.py",
    "tests/cli/cell/test_calibrate.py",
    "tests/calibration/automatic/test_calibrate.py",
    "tests/end_to_end/test_whole_way.py",
    "tests/estimator/month/test_summary.py",
    "tests/estimator/anywhere/test_anywhere.py",
    "tests/kernels/test_cache_folder.py",
    "tests/service/test_process.py",
    "tests/service/test_kernel_compilation.py",
    "tests/deploy/test_wheel.py",
    "tests/deploy/test_machines.py",
    "tests/fleet/worker/test_partition.py",
    "tests/fleet/worker/test_pack_fits.py",
    "tests/fleet/ingest/test_backfill.py",
    "tests/fleet/ingest/test_ingest.py",
    "tests/fleet/page/test_browser.py",
    "tests/reports/test_report_in_browser.py",
    "tests/page/test_setup.py",
    "tests/test_docs.py",
    "tests/test_api.py",
    "tests/library/test_notebook.py",
    "tests/world/test_world.py",
    "tests/telemetry/test_alarms.py",
    "tests/cli/captures/test_report.py",
    "tests/pack_model/test_fit.py",
    "tests/sinks/mqtt/test_sink.py",
    "tests/cli/captures/test_replay.py",
)
"""Test files that take longest, by CPU time and waits. They run first, because otherwise one worker could still run one of them
at the end."""

NUMBERS = itertools.count()
"""Numbers of the tests' state folders."""
DATA = Path(__file__).parent / "data"
SHARED_DATA = Path(__file__).parents[2] / "shared" / "data"


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Import the tests without garbage collection, which would search the many objects of their modules again and again."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()
        gc.freeze()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the tests of ``LONG_FILES`` first. The others follow in the order of collection."""
    places = {file: place for place, file in enumerate(LONG_FILES)}
    items.sort(key=lambda item: places.get(item.nodeid.partition("::")[0], len(places)))


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile the kernels once, before the workers and programs under test need them.

    Otherwise each worker would compile them, and the programs would print that they do, which no test expects.
    """
    if not hasattr(session.config, "workerinput"):  # in the main process of pytest-xdist, or without it
        load_kernels()


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Return the folder of the real captures. Without it, skip the test and name the path."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"real captures are absent: {SHARED_DATA} does not exist (docs/contributing/tests.md)")
    return SHARED_DATA


@pytest.fixture(scope="session")
def data() -> Path:
    """Return the folder of the captures of the tests."""
    return DATA


@pytest.fixture(autouse=True)
def state_home(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Name a state folder that belongs to this test for programs, and return it. It does not exist yet."""
    folder = tmp_path_factory.getbasetemp() / f"state-home-{next(NUMBERS)}"
    monkeypatch.setenv("XDG_STATE_HOME", str(folder))
    return folder


@pytest.fixture
def few_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make forecasts from fewer draws, for tests of other values of a pack that runs for hours."""
    monkeypatch.setattr(projection, "DRAWS", 40)
    monkeypatch.setattr(projection, "CURVE_DRAWS", 40)


@pytest.fixture
def empty_plots(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave plots empty, for tests of the texts and tables of reports."""
    monkeypatch.setattr(report_parts, "_svg", lambda *_: "<svg></svg>")
