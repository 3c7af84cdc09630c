"""Cache folder of compiled kernels, named by a hash of all their sources, and operation without a cache."""

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
ELF, HEADER_BYTES = b"\x7fELF", 64
"""First bytes of a kernel's object file; its machine code follows the header."""


def imported(source: Path) -> set[Path]:
    """Return the files of the package that one of its files imports."""
    names = [node.module for node in ast.walk(ast.parse(source.read_text())) if isinstance(node, ast.ImportFrom)]
    paths = [PACKAGE.parent / f"{name.replace('.', '/')}.py" for name in names if name]
    return {path for path in paths if path.is_relative_to(PACKAGE) and path.is_file()}


def test_every_file_with_compiled_code_is_in_the_caches_name() -> None:
    compiled = {path for path in PACKAGE.rglob("*.py") if re.search(r"^@njit\b", path.read_text(), re.MULTILINE)}
    assert PACKAGE / "protocols" / "firmware" / "framing.py" in compiled
    assert compiled <= set(numba_cache.COMPILED_IN)


def test_every_file_that_a_kernel_imports_is_in_the_caches_name() -> None:
    found = set().union(*(imported(source) for source in numba_cache.COMPILED_IN)) - {PACKAGE / "numba_cache.py"}
    assert PACKAGE / "model" / "input_faults.py" in found
    assert found <= set(numba_cache.COMPILED_IN)


def test_every_kernel_takes_njit_from_the_cache() -> None:
    direct = {
        path for path in PACKAGE.rglob("*.py") if re.search(r"^from numba import njit", path.read_text(), re.MULTILINE)
    }
    assert direct == {PACKAGE / "numba_cache.py"}


def crc16_with_cache_in(folder: Path) -> str:
    """Compile a kernel in another process and check its result; return the text on stderr."""
    homes = dict.fromkeys(("NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "HOME"), str(folder))
    script = "import numpy; from bms_estimator.protocols.firmware.framing import crc16; print(crc16(numpy.zeros(4, 'u1'), 0, 4))"
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, env=os.environ | homes, capture_output=True, text=True, timeout=LONG_S, check=False)
    assert (done.returncode, done.stdout) == (0, "33984\n"), done.stderr
    return done.stderr


def test_a_kernel_runs_without_space_for_its_cache(full_disk: Path) -> None:
    said = crc16_with_cache_in(full_disk)
    assert "RuntimeWarning: compiled kernels are not kept: No space left on device" in said


def test_a_kernel_runs_without_a_folder_for_its_cache(disk_without_files: Path) -> None:
    said = crc16_with_cache_in(disk_without_files)
    assert "RuntimeWarning: compiled kernels are not kept: no folder can be written" in said


def test_a_kernel_runs_for_a_user_without_a_home() -> None:
    assert "RuntimeWarning: compiled kernels are not kept: no folder can be written" in crc16_with_cache_in(Path("~"))


@pytest.fixture(scope="module")
def kept_kernel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with a compiled kernel."""
    folder = tmp_path_factory.mktemp("kernel")
    assert crc16_with_cache_in(folder) == ""
    return folder


def cut(content: bytes) -> bytes:
    return content[:20]


def emptied(_: bytes) -> bytes:
    return b""


def zeros_in_its_code(content: bytes) -> bytes:
    """Replace machine code with zeros, as a power failure may on a file system that preserves the length of files."""
    code = content.index(ELF) + HEADER_BYTES
    return content[:code] + bytes(64) + content[code + 64 :]


@pytest.mark.parametrize(
    ("kind", "damaged"),
    [
        ("nbi", cut),
        pytest.param("nbi", emptied, marks=pytest.mark.thorough),
        pytest.param("nbc", cut, marks=pytest.mark.thorough),
        pytest.param("nbc", emptied, marks=pytest.mark.thorough),
        ("nbc", zeros_in_its_code),
    ],
)
def test_a_damaged_kernel_in_the_cache_is_compiled_again(
    tmp_path: Path, kept_kernel: Path, kind: str, damaged: Callable[[bytes], bytes]
) -> None:
    shutil.copytree(kept_kernel, tmp_path, dirs_exist_ok=True)
    (kept,) = tmp_path.rglob(f"*.{kind}")
    whole = kept.stat().st_size
    kept.write_bytes(damaged(kept.read_bytes()))
    assert "RuntimeWarning: a compiled kernel cannot be read" in crc16_with_cache_in(tmp_path)
    assert kept.stat().st_size == whole
    assert crc16_with_cache_in(tmp_path) == ""
