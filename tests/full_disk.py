"""Real file system without free space."""

import contextlib
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest


@contextlib.contextmanager
def small_disk(disk: Path, size: str) -> Iterator[Path]:
    """Mount a file system of a size, such as ``4k``, in a new folder, and return the folder."""
    if os.geteuid() != 0:
        pytest.skip("only root can mount a file system")
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "none", disk], check=False).returncode != 0:
        pytest.skip("no file system can be mounted here")
    try:
        yield disk
    finally:
        subprocess.run(["umount", "--lazy", disk], check=True)


@pytest.fixture
def full_disk(tmp_path: Path) -> Iterator[Path]:
    """Mount a full file system and return its folder. Only empty files and folders can be created in it."""
    with small_disk(tmp_path / "disk", "4k") as disk:
        (disk / "file").write_bytes(bytes(4096))
        yield disk


@pytest.fixture
def disk_without_files(full_disk: Path) -> Path:
    """Mount a full file system on which not even a folder can be created."""
    inodes = os.statvfs(full_disk).f_files - os.statvfs(full_disk).f_ffree
    subprocess.run(["mount", "-o", f"remount,nr_inodes={inodes}", full_disk], check=True)
    return full_disk
