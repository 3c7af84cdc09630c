"""Packages and compiled kernels for arm64, made on a machine of any architecture.

``python deploy/debian/arm64.py`` compiles the kernels to the folder NUMBA_CACHE_DIR. LLVM generates the same machine code as on
arm64. The code is not executed here.
"""

import shutil
import subprocess
import sys
from pathlib import Path

import llvmlite.binding as llvm

TRIPLE = "aarch64-unknown-linux-gnu"
MACHINE = "aarch64"
"""Name of the architecture as in ``uname -m``."""
GLIBC_MINORS = range(17, 37)
"""Minor versions of the glibc 2 for which wheels are used: up to that of Debian 12."""


def install_packages(requirements: str, site_packages: Path) -> None:
    """Install packages for arm64, and move their programs to the environment's folder ``bin``.

    Args:
        requirements: Lines of requirements.lock, with hashes.
        site_packages: Folder of the packages.
    """
    lock = site_packages / "requirements.lock"
    lock.write_text(requirements, encoding="utf-8")
    platforms = [f"--platform=manylinux_2_{minor}_{MACHINE}" for minor in GLIBC_MINORS]
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-compile", "--no-deps", "--require-hashes"]
    command += ["--disable-pip-version-check", f"--target={site_packages}", f"--platform=manylinux2014_{MACHINE}"]
    subprocess.run([*command, *platforms, f"--requirement={lock}"], check=True)
    lock.unlink()
    for library in site_packages.rglob(
        "*-x86_64-linux-gnu.so"
    ):  # compiled for this machine; the package works without it
        library.unlink()
    programs = site_packages / "bin"
    shutil.copy2(programs / "nats-server", site_packages.parents[2] / "bin")
    shutil.rmtree(programs)


def replace_target() -> None:
    """Make numba compile for arm64. The caller imports numba afterwards."""
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    llvm.get_process_triple = lambda: TRIPLE
    llvm.Target.from_default_triple = lambda: llvm.Target.from_triple(TRIPLE)


if __name__ == "__main__":
    replace_target()
    from bms_estimator.service.kernel_compilation import argument_types, compile_call, compile_order

    names = argument_types()
    for kernel in compile_order():
        compile_call(kernel.call, names)
