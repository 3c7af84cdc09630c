"""Build the Debian package of the program: ``make deb``, and ``make deb-arm64`` for arm64 on any machine.

The package has a virtual environment in /usr/lib/bms-estimator with the wheel of this checkout and the packages that it
requires. For this machine's architecture they are copied from the environment of this script, which is installed from
requirements.lock with its hashes. For arm64 they are installed with the same versions and hashes.
The package contains the compiled kernels for its architecture and for the minor version of Python of this script.
The maintainer scripts run ``bms-estimator install`` and ``uninstall``.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import zipfile
from email.utils import formatdate
from importlib.metadata import Distribution
from pathlib import Path

import arm64

from bms_estimator.installation import paths
from bms_estimator.installation.program_copy import (
    DISTRIBUTION,
    PACKAGE,
    PYTHON,
    copy_packages,
    create_environment,
    required_packages,
    system_python,
)
from bms_estimator.numba_cache import CACHE_FOLDER
from bms_estimator.service.kernel_compilation import COMPLETE_FILE, compile_kernels

PROJECT = Path(__file__).parents[2]
EXTRAS = ("calibration", "can", "modbus", "prometheus", "report")
"""Extras of the program in the package: those of a service beside a pack, and of `calibrate` and `report`."""
ENVIRONMENT = Path("/usr/lib/bms-estimator")
SCRIPTS = Path(__file__).parent / "scripts"
"""Folder with the maintainer scripts."""
LOCKED = re.compile(r"(?m)^([\w.-]+)==([^\s;\\]+).*\n(?: .*\n)*")
"""Lines of a package in requirements.lock."""
MAINTAINER = "bms_estimator <bms-estimator@localhost>"


def build(output: Path, compression: str, architecture: str) -> Path:
    """Build the package in a new folder ``output``. Return the path of the package.

    Args:
        output: Folder for the package and its parts; an earlier one is replaced.
        compression: Compression of the package, as for ``dpkg-deb -Z``.
        architecture: Debian's name of the package's architecture: that of this machine, or arm64.
    """
    shutil.rmtree(output, ignore_errors=True)
    root = output / "root"
    site_packages = create_environment(
        root / ENVIRONMENT.relative_to("/"), installed_as=ENVIRONMENT, python=system_python()
    )
    with zipfile.ZipFile(build_wheel(output)) as wheel:
        wheel.extractall(site_packages)
    program = Distribution.at(next(site_packages.glob(f"{DISTRIBUTION}-*.dist-info")))
    packages = required_packages(program, EXTRAS)
    locked = locked_packages(packages)
    if architecture == own_architecture():
        copy_packages(packages, site_packages)
        compile_kernels()
        copy_kernels(kernel_folder(), os.uname().machine, site_packages)
    else:
        arm64.install_packages(locked, site_packages)
        cache, digest = kernel_folder().parent, kernel_folder().name
        cache = cache.with_name(f"{cache.name}-{arm64.MACHINE}")
        subprocess.run([sys.executable, arm64.__file__], env=os.environ | {"NUMBA_CACHE_DIR": str(cache)}, check=True)
        copy_kernels(cache / digest, arm64.MACHINE, site_packages)
    for folder in list(site_packages.rglob("__pycache__")):  # postinst compiles the files on the machine
        shutil.rmtree(folder)
    link = root / "usr/bin/bms-estimator"
    link.parent.mkdir()
    link.symlink_to(f"..{ENVIRONMENT.as_posix().removeprefix('/usr')}/bin/bms-estimator")
    version = program.version.replace(".dev", "~dev")  # Debian orders 0.1.0~dev1 before 0.1.0, but 0.1.0.dev1 after it
    write_documents(root / "usr/share/doc/bms-estimator", version)
    write_control(root / "DEBIAN", version, architecture, size_kib(root))
    subprocess.run(["chmod", "-R", "u=rwX,go=rX", root], check=True)
    for library in site_packages.rglob("*.so*"):  # libraries of a Debian package are not executable
        library.chmod(0o644)
    package = output / f"bms-estimator_{version}_{architecture}.deb"
    subprocess.run(["dpkg-deb", "--root-owner-group", f"-Z{compression}", "--build", root, package], check=True)
    return package


def kernel_folder() -> Path:
    """Return the folder of the kernels that this machine compiles."""
    if CACHE_FOLDER is None:
        sys.exit("no folder for compiled kernels can be written: set NUMBA_CACHE_DIR=FOLDER")
    return CACHE_FOLDER


def copy_kernels(folder: Path, machine: str, site_packages: Path) -> None:
    """Copy the compiled kernels in ``folder`` to the package, so that no machine compiles them."""
    target = site_packages / PACKAGE.name / "compiled" / folder.name
    version = f"py{sys.version_info.major}{sys.version_info.minor}"
    for file in folder.rglob(f"*.{version}.*.nbc"):
        (target / file.relative_to(folder)).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, target / file.relative_to(folder))
    (target / COMPLETE_FILE.replace(os.uname().machine, machine)).touch()


def build_wheel(output: Path) -> Path:
    """Build the wheel of this checkout. Return its path."""
    command = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", output.resolve()]
    subprocess.run(command, cwd=PROJECT, check=True, stdout=subprocess.DEVNULL)
    return next(output.glob("*.whl"))


def locked_packages(packages: list[Distribution]) -> str:
    """Return the lines of requirements.lock for packages. End with an error if an installed one has another version."""
    lock = (PROJECT / "requirements.lock").read_text(encoding="utf-8")
    lines = {(normalize(line[1]), line[2]): line[0] for line in LOCKED.finditer(lock)}
    for package in packages:
        if (normalize(package.name), package.version) not in lines:
            sys.exit(f"{package.name} {package.version} is not the version of requirements.lock: make venv")
    return "".join(lines[normalize(package.name), package.version] for package in packages)


def normalize(name: str) -> str:
    """Return the normalized form of the name of a Python package."""
    return re.sub(r"[-_.]+", "-", name).lower()


def own_architecture() -> str:
    """Return Debian's name of this machine's architecture."""
    return subprocess.run(["dpkg", "--print-architecture"], capture_output=True, text=True, check=True).stdout.strip()


def size_kib(root: Path) -> int:
    """Return the size of all files [KiB]."""
    return sum(path.lstat().st_size for path in root.rglob("*")) // 1024


def write_documents(folder: Path, version: str) -> None:
    """Write copyright and changelog."""
    folder.mkdir(parents=True)
    packages = "the licenses of the bundled packages are in /usr/lib/bms-estimator/lib/*/site-packages/*.dist-info"
    license_text = (PROJECT / "LICENSE").read_text(encoding="utf-8")
    (folder / "copyright").write_text(f"bms_estimator; {packages}\n\n{license_text}", encoding="utf-8")
    entry = f"bms-estimator ({version}) unstable; urgency=medium\n\n  * See CHANGELOG.md of the project.\n\n"
    entry += f" -- {MAINTAINER}  {formatdate()}\n"
    compressed = subprocess.run(["gzip", "-9n"], input=entry.encode(), capture_output=True, check=True).stdout
    (folder / "changelog.gz").write_bytes(compressed)


def write_control(folder: Path, version: str, architecture: str, installed_kib: int) -> None:
    """Write the package's description and its maintainer scripts."""
    folder.mkdir()
    minor = sys.version_info.minor
    (folder / "control").write_text(
        f"""\
Package: bms-estimator
Version: {version}
Architecture: {architecture}
Maintainer: {MAINTAINER}
Installed-Size: {installed_kib}
Depends: {PYTHON}, python3 (>= 3.{minor}), python3 (<< 3.{minor + 1}~), libc6, libstdc++6, passwd, systemd, udev
Section: misc
Priority: optional
Description: real-time estimator for Li-ion battery packs
 A service that reads a BMS, a battery monitor or a sensor board, estimates
 state of charge and parameters with their uncertainty, and publishes them over
 MQTT, in Home Assistant and on a web page.
""",
        encoding="utf-8",
    )
    purged = (paths.SETTINGS, paths.STATE, *map(paths.drop_ins, (paths.UNIT, paths.TEMPLATE)))
    for script in SCRIPTS.iterdir():
        text = script.read_text(encoding="utf-8").replace("@PURGED@", " ".join(map(str, purged)))
        (folder / script.name).write_text(text, encoding="utf-8")
        (folder / script.name).chmod(0o755)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Build the Debian package.")
    parser.add_argument("output", type=Path, help="new folder for the package and its parts")
    parser.add_argument(
        "--compression", default="xz", help="compression of the package, as for dpkg-deb -Z; default: xz"
    )
    parser.add_argument("--arm64", action="store_true", help="build for arm64 on another machine")
    arguments = parser.parse_args()
    target = "arm64" if arguments.arm64 else own_architecture()
    sys.stdout.write(f"{build(arguments.output, arguments.compression, target)}\n")
