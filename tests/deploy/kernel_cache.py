"""Kernel cache for a service with its own cache folder, from the tests' compiled kernels."""

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


def fill(cache: Path, package: Path = PACKAGE, omitted: str | None = OMITTED) -> None:
    """Copy the tests' compiled kernels, except those whose files begin with ``omitted``, to ``cache``.

    A process that imports the package from ``package`` can use them.
    """
    load_kernels()
    compiled = Path(numba.config.CACHE_DIR)
    subfolder_of = _CacheLocator.get_suitable_cache_subpath  # numba's name for the folder of a source file
    for folder in {source.parent.relative_to(PACKAGE) for source in COMPILED_IN}:
        cached = compiled / subfolder_of(str(PACKAGE / folder / "any.py"))
        if cached.is_dir():
            shutil.copytree(
                cached,
                cache / compiled.name / subfolder_of(str(package / folder / "any.py")),
                ignore=shutil.ignore_patterns("*.tmp.*", *([f"{omitted}*"] if omitted else [])),
            )
