"""Copy of the tests' compiled kernels for a program with another cache folder."""

import shutil
from pathlib import Path

import numba

from bms_estimator.service.kernel_warm_up import load_kernels

OMITTED = "step.run-"
"""Prefix of the files of the kernel that the service has to compile."""


def fill(cache: Path, omitted: str | None = OMITTED) -> None:
    """Copy the tests' compiled kernels, except those whose files begin with ``omitted``, to ``cache``."""
    load_kernels()
    compiled = Path(numba.config.CACHE_DIR)
    left_out = ["lock", "*.tmp.*", *([f"{omitted}*"] if omitted else [])]
    shutil.copytree(compiled, cache / compiled.name, ignore=shutil.ignore_patterns(*left_out))
