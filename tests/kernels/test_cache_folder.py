"""Cache of compiled kernels: its folder is named by a hash of all their sources. Kernels also run without a cache."""

import ast
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import bms_estimator
from bms_estimator import numba_cache
from tests.patience import LONG_S

PACKAGE = Path(bms_estimator.__file__).parent
ELF = b"\x7fELF"
"""First bytes of the object file that contains a kernel's machine code."""
HEADER_BYTES = 64
"""Size of the header of a 64-bit object file, before the machine code [bytes]."""


def imported_files(source: Path) -> set[Path]:
    """Return the files of the package that one of its files imports."""
    names = [node.module for node in ast.walk(ast.parse(source.read_text())) if isinstance(node, ast.ImportFrom)]
    paths = [PACKAGE.parent / f"{name.replace('.', '/')}.py" for name in names if name]
    return {path for path in paths if path.is_relative_to(PACKAGE) and path.is_file()}


def test_the_hash_of_the_cache_name_covers_every_file_with_compiled_code() -> None:
    compiled = {path for path in PACKAGE.rglob("*.py") if re.search(r"^@njit\b", path.read_text(), re.MULTILINE)}
    assert PACKAGE / "protocols" / "firmware" / "framing.py" in compiled
    assert compiled <= set(numba_cache.COMPILED_SOURCES)


def test_the_hash_of_the_cache_name_covers_every_file_that_a_kernel_imports() -> None:
    dependencies = set().union(*(imported_files(source) for source in numba_cache.COMPILED_SOURCES)) - {
        PACKAGE / "numba_cache.py"
    }
    assert PACKAGE / "model" / "input_faults.py" in dependencies
    assert dependencies <= set(numba_cache.COMPILED_SOURCES)


def test_only_numba_cache_imports_njit_from_numba() -> None:
    direct_importers = {
        path
        for path in PACKAGE.rglob("*.py")
        if re.search(r"^from numba import .*\bnjit|= numba\.njit", path.read_text(), re.MULTILINE)
    }
    assert direct_importers == {PACKAGE / "numba_cache.py"}


CRC16_OF_FOUR_ZEROS = "33984\n"
"""Output of the kernel that the tests run."""


def run_crc16_with_cache_in(folder: Path) -> str:
    """Run a kernel in another process whose cache folders are all ``folder``; check its result and return stderr."""
    cache_variables = dict.fromkeys(("NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "HOME"), str(folder))
    script = "import numpy; from bms_estimator.protocols.firmware.framing import crc16; print(crc16(numpy.zeros(4, 'u1'), 0, 4))"
    command = [sys.executable, "-c", script]
    process = subprocess.run(
        command, env=os.environ | cache_variables, capture_output=True, text=True, timeout=LONG_S, check=False
    )
    assert (process.returncode, process.stdout) == (0, CRC16_OF_FOUR_ZEROS), process.stderr
    return process.stderr


def test_a_kernel_runs_without_space_for_its_cache(full_disk: Path) -> None:
    warning = run_crc16_with_cache_in(full_disk)
    assert "RuntimeWarning: compiled kernels are not stored: No space left on device" in warning


@pytest.mark.thorough
def test_a_kernel_runs_without_a_folder_for_its_cache(disk_without_files: Path) -> None:
    warning = run_crc16_with_cache_in(disk_without_files)
    assert "RuntimeWarning: compiled kernels are not stored: no folder can be written" in warning


def test_a_kernel_runs_for_a_user_without_a_home() -> None:
    assert "RuntimeWarning: compiled kernels are not stored: no folder can be written" in run_crc16_with_cache_in(
        Path("~")
    )


COMPILES_WHILE_ANOTHER_WAITS = """
import sys, numpy
from numba.core import event
from bms_estimator.protocols.firmware.framing import crc16
class WaitForInput(event.Listener):
    waited = False
    def on_start(self, _):
        if not self.waited:  # functions of numba that the kernel calls are compiled, too
            self.waited = True
            print("compiling", flush=True)
            sys.stdin.readline()
    def on_end(self, _): pass
with event.install_listener("numba:compile", WaitForInput()):
    print("begins", flush=True)
    print(crc16(numpy.zeros(4, "u1"), 0, 4), sum(crc16.stats.cache_misses.values()), flush=True)
"""
"""Program that waits for a line of input in the middle of the compilation, and prints the number of compilations."""


def test_a_kernel_that_another_process_compiles_is_not_compiled_again(tmp_path: Path) -> None:
    def start() -> subprocess.Popen[str]:
        command, variables = [sys.executable, "-c", COMPILES_WHILE_ANOTHER_WAITS], {"NUMBA_CACHE_DIR": str(tmp_path)}
        pipe = subprocess.PIPE
        return subprocess.Popen(command, env=os.environ | variables, stdin=pipe, stdout=pipe, text=True)

    with start() as first:
        assert first.stdout.readline() == "begins\n"
        assert first.stdout.readline() == "compiling\n"
        with start() as second:
            assert second.stdout.readline() == "begins\n"
            first.stdin.write("\n")
            first.stdin.flush()
            assert first.stdout.readline() == "33984 1\n"
            assert second.stdout.readline() == "33984 0\n"


OUTSIDE_KERNEL = """
from bms_estimator.numba_cache import njit
@njit(cache=True)
def tripled(x): return {factor} * x
"""
"""Source of a kernel that is not in the package."""


def test_a_kernel_outside_the_package_is_compiled_once_for_each_content_of_its_file(tmp_path: Path) -> None:
    script = "from outside import tripled; print(tripled(2.0), sum(tripled.stats.cache_hits.values()))"
    variables = {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(tmp_path)}
    printed = []
    for factor in ("3.0", "3.0", "30.0"):
        (tmp_path / "outside.py").write_text(OUTSIDE_KERNEL.format(factor=factor))
        command = [sys.executable, "-c", script]
        printed.append(subprocess.check_output(command, env=os.environ | variables, text=True))
    assert printed == ["6.0 0\n", "6.0 1\n", "60.0 0\n"]


@pytest.fixture(scope="module")
def cached_kernel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a cache folder with a compiled kernel."""
    folder = tmp_path_factory.mktemp("kernel")
    assert run_crc16_with_cache_in(folder) == ""
    return folder


@pytest.mark.parametrize("shipped", [True, pytest.param(False, marks=pytest.mark.thorough)])
def test_another_installation_of_the_same_version_loads_shipped_and_cached_kernels(
    cached_kernel: Path, tmp_path: Path, shipped: bool
) -> None:
    shutil.copytree(PACKAGE, tmp_path / "bms_estimator", ignore=shutil.ignore_patterns("compiled"))
    cache = cached_kernel
    if shipped:
        shutil.copytree(cached_kernel, tmp_path / "bms_estimator" / "compiled")
        cache = tmp_path / "empty"
    script = """
import os, numba, numpy
os.environ["NUMBA_WARNINGS"] = "0"  # numba reads its settings again
import bms_estimator
from bms_estimator.protocols.firmware.framing import crc16
print(bms_estimator.__file__, crc16(numpy.zeros(4, "u1"), 0, 4), sum(crc16.stats.cache_misses.values()))
"""
    variables = {"PYTHONPATH": str(tmp_path), "NUMBA_CACHE_DIR": str(cache)}
    command = [sys.executable, "-P", "-c", script]  # -P: the working folder may contain the package, too
    output = subprocess.check_output(command, env=os.environ | variables, text=True)
    assert output == f"{tmp_path}/bms_estimator/__init__.py 33984 0\n"


def test_loading_a_kernel_imports_no_linear_algebra_and_others_may_still_use_it(cached_kernel: Path) -> None:
    script = """
import sys, numpy
from bms_estimator.protocols.firmware.framing import crc16
print(crc16(numpy.zeros(4, "u1"), 0, 4), "scipy.linalg" in sys.modules)
from numba.np.linalg import ensure_blas
ensure_blas()
"""
    variables = {"NUMBA_CACHE_DIR": str(cached_kernel)}
    output = subprocess.check_output([sys.executable, "-c", script], env=os.environ | variables, text=True)
    assert output == "33984 False\n"


def truncate(content: bytes) -> bytes:
    """Return only the first 20 bytes, which end within the header."""
    return content[:20]


def empty(_: bytes) -> bytes:
    """Return no bytes, as in a file that was created but not written."""
    return b""


def erase_machine_code(content: bytes) -> bytes:
    """Replace machine code with zeros.

    A power failure has this effect on a file system that saves the length of a file before its content.
    """
    begin, erased_bytes = content.index(ELF) + HEADER_BYTES, 64
    return content[:begin] + bytes(erased_bytes) + content[begin + erased_bytes :]


@pytest.mark.parametrize(
    "damage",
    [
        pytest.param(truncate, marks=pytest.mark.thorough),
        pytest.param(empty, marks=pytest.mark.thorough),
        erase_machine_code,
    ],
)
def test_a_damaged_kernel_in_the_cache_is_compiled_again(
    tmp_path: Path, cached_kernel: Path, damage: Callable[[bytes], bytes]
) -> None:
    shutil.copytree(cached_kernel, tmp_path, dirs_exist_ok=True)
    (file,) = tmp_path.rglob("*.nbc")
    size_before = file.stat().st_size
    file.write_bytes(damage(file.read_bytes()))
    assert "RuntimeWarning: a compiled kernel cannot be read" in run_crc16_with_cache_in(tmp_path)
    assert file.stat().st_size == size_before
    assert run_crc16_with_cache_in(tmp_path) == ""
