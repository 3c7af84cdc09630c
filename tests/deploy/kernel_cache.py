"""A cache of kernels for a service that keeps its own: what the tests have compiled, but for one kernel."""

import shutil
from pathlib import Path

import numba
from numba.core.caching import _CacheLocator

from bms_estimator import kernels
from bms_estimator.service.warm_up import load_kernels

KERNELS = Path(kernels.__file__)
LEFT_OUT = "sample_step.run-"
"""Begin of the names of the kernel's files that the service has to compile itself."""


def fill(cache: Path, sources: Path = KERNELS) -> None:
    """Fill a cache for kernels that will lie where ``sources`` says."""
    load_kernels()
    compiled = Path(numba.config.CACHE_DIR)
    named = _CacheLocator.get_suitable_cache_subpath  # by the folder of the sources
    shutil.copytree(
        compiled / named(str(KERNELS)),
        cache / compiled.name / named(str(sources)),
        ignore=shutil.ignore_patterns(f"{LEFT_OUT}*", "*.tmp.*"),
    )
