"""A cache of kernels for a service that keeps its own: what the tests have compiled, but for one kernel."""

import shutil
from pathlib import Path

import numba
from numba.core.caching import _CacheLocator

import bms_estimator
from bms_estimator.service.warm_up import load_kernels

PACKAGE = Path(bms_estimator.__file__).parent
COMPILED = ("kernels", "sources/wire")
"""Folders of compiled code: numba gives each one of its own in the cache."""
LEFT_OUT = "sample_step.run-"
"""Begin of the names of the kernel's files that the service has to compile itself."""


def fill(cache: Path, package: Path = PACKAGE) -> None:
    """Fill a cache for a package that will lie where ``package`` says."""
    load_kernels()
    compiled = Path(numba.config.CACHE_DIR)
    named = _CacheLocator.get_suitable_cache_subpath  # by the folder of a source
    for folder in COMPILED:
        shutil.copytree(
            compiled / named(str(PACKAGE / folder / "any.py")),
            cache / compiled.name / named(str(package / folder / "any.py")),
            ignore=shutil.ignore_patterns(f"{LEFT_OUT}*", "*.tmp.*"),
        )
