"""Kernel cache for a service with its own cache folder: the tests' compiled kernels except one."""

import shutil
from pathlib import Path

import numba
from numba.core.caching import _CacheLocator

import bms_estimator
from bms_estimator.numba_cache import COMPILED_IN
from bms_estimator.service.kernel_warm_up import load_kernels

PACKAGE = Path(bms_estimator.__file__).parent
OMITTED = "step.run-"
"""Prefix of the files of the kernel that the service has to compile."""


def fill(cache: Path, package: Path = PACKAGE) -> None:
    """Fill a cache for a package at ``package``."""
    load_kernels()
    compiled = Path(numba.config.CACHE_DIR)
    named = _CacheLocator.get_suitable_cache_subpath  # by the folder of a source
    for folder in {source.parent.relative_to(PACKAGE) for source in COMPILED_IN}:
        cached = compiled / named(str(PACKAGE / folder / "any.py"))
        if cached.is_dir():
            shutil.copytree(
                cached,
                cache / compiled.name / named(str(package / folder / "any.py")),
                ignore=shutil.ignore_patterns(f"{OMITTED}*", "*.tmp.*"),
            )
