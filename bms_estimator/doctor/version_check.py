"""Versions of the program and of what it depends on, for a bug report."""

import platform
from collections.abc import Iterator
from importlib.metadata import version

from bms_estimator.doctor.finding import Finding, ok
from bms_estimator.version import __version__

PACKAGES = ("numba", "numpy", "aiomqtt", "pydantic", "pyserial")
"""Packages whose versions are reported."""


def check_versions() -> Iterator[Finding]:
    """Yield the versions."""
    packages = ", ".join(f"{name} {version(name)}" for name in PACKAGES)
    system = f"{platform.system()} {platform.release()} {platform.machine()}"
    yield ok("versions", f"bms-estimator {__version__}, Python {platform.python_version()}, {packages}, {system}")
