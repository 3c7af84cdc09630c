"""Copy of the tests' compiled kernels for a program with another cache folder."""

import shutil
from pathlib import Path

from bms_estimator.numba_cache import CACHE_FOLDER
from bms_estimator.service.kernel_warm_up import load_kernels

OMITTED = "step.run-"
"""Prefix of the files of the kernel that the service has to compile."""


def fill(cache: Path, omitted: str | None = OMITTED) -> None:
    """Copy the tests' compiled kernels, except those whose files begin with ``omitted``, to ``cache``."""
    load_kernels()
    left_out = ["lock", "*.tmp.*", *([f"{omitted}*"] if omitted else [])]
    shutil.copytree(CACHE_FOLDER, cache / CACHE_FOLDER.name, ignore=shutil.ignore_patterns(*left_out))
