"""Checks of state folder and kernel cache."""

import os
import subprocess
from pathlib import Path

import pytest

from bms_estimator.doctor import kernel_check
from bms_estimator.doctor.examine import check_disk
from bms_estimator.doctor.finding import Level
from bms_estimator.doctor.kernel_check import check_kernels
from bms_estimator.numba_cache import source_digest
from bms_estimator.service.kernel_compilation import COMPLETE_FILE
from tests.doctor.as_user import as_nobody
from tests.doctor.packs import subject, unit_with


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return an empty cache folder, the only one."""
    folder = tmp_path / "cache"
    folder.mkdir()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(folder))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "absent"))
    return folder


def write(file: Path, size: int) -> None:
    """Write a file of ``size`` bytes without content on the disk."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file.touch()
    os.truncate(file, size)


def test_a_missing_state_folder_in_a_writable_folder_is_no_fault(tmp_path: Path) -> None:
    pack = subject(tmp_path)
    (finding,) = check_disk(pack)
    assert finding.level is Level.OK
    assert finding.text.startswith(f"{pack.state_folder}: 0 MB used")
    assert not pack.state_folder.exists()


def test_a_state_folder_that_the_user_may_not_write_is_a_fault(tmp_path: Path) -> None:
    pack = subject(tmp_path)
    pack.state_folder.mkdir(mode=0o500)
    (finding,) = as_nobody(lambda: list(check_disk(pack)))
    assert finding.level is Level.FAULT
    assert "chown" in finding.remedy


def test_a_full_disk_is_a_fault_and_a_small_one_a_warning(full_disk: Path) -> None:
    (full,) = check_disk(subject(full_disk))
    assert (full.level, "the disk is full" in full.text) == (Level.FAULT, True)
    subprocess.run(["mount", "-o", "remount,size=64m", full_disk], check=True)
    (small,) = check_disk(subject(full_disk))
    assert (small.level, "a history of 366 days needs 83 MB" in small.text) == (Level.WARNING, True)
    (enough,) = check_disk(subject(full_disk, store={"history_days": 30}))
    assert enough.level is Level.OK


def test_kernels_are_cold_until_all_are_compiled(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (cold,) = check_kernels(None)
    assert (cold.level, "not compiled yet" in cold.text) == (Level.WARNING, True)
    monkeypatch.setattr(kernel_check, "available_bytes", lambda: 200 << 20)
    _, memory = check_kernels(None)
    assert (memory.level, "compiling needs 256 MiB of memory, and 200 MiB" in memory.text) == (Level.WARNING, True)
    write(cache / source_digest() / COMPLETE_FILE, 3_000_000)
    (warm,) = check_kernels(None)
    assert (warm.level, warm.text) == (Level.OK, f"{cache / source_digest()}: compiled, 3 MB")


def test_many_other_versions_are_a_warning_with_the_command_that_removes_them(cache: Path) -> None:
    for number in range(4):
        write(cache / f"old{number}" / "kernels" / "step.step-1.py311.nbc", 1)
    _, old = check_kernels(None)
    assert (old.level, "4 other versions" in old.text) == (Level.WARNING, True)
    assert "other installed versions then compile theirs again" in old.remedy
    (cache / source_digest()).mkdir()
    subprocess.run(["sh", "-c", old.remedy], check=True)
    assert [folder.name for folder in cache.iterdir()] == [source_digest()]


def test_without_a_writable_cache_folder_there_is_a_warning(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cache.chmod(0o500)
    (finding,) = as_nobody(lambda: list(check_kernels(None)))
    assert finding.level is Level.WARNING
    assert "no folder can be written" in finding.text


def test_the_cache_of_the_service_is_examined_if_there_is_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bms_estimator.doctor.finding.CACHE_ROOT", tmp_path)
    write(tmp_path / "bms-estimator" / source_digest() / COMPLETE_FILE, 1)
    (warm,) = check_kernels(subject(tmp_path, unit=unit_with()))
    assert warm.level is Level.OK
    assert kernel_check.size_of(tmp_path) == 1
