"""Build the Debian package of the program: ``make deb``.

The package has a virtual environment in /usr/lib/bms-estimator with the wheel of this checkout and the packages that it
requires. They are copied from the environment of this script, which is installed from requirements.lock with its hashes.
It contains the compiled kernels, for the minor version of Python and the architecture of the machine that builds it.
The maintainer scripts run ``bms-estimator install`` and ``uninstall``.
"""

import argparse
import re
import shutil
import subprocess
import sys
import zipfile
from email.utils import formatdate
from importlib.metadata import Distribution
from pathlib import Path

from bms_estimator.installation import places
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
MAINTAINER = "bms_estimator <bms-estimator@localhost>"


def build(output: Path, compression: str) -> Path:
    """Build the package in a new folder ``output``. Return the path of the package.

    Args:
        output: Folder for the package and its parts; an earlier one is replaced.
        compression: Compression of the package, as for ``dpkg-deb -Z``.
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
    require_locked(packages)
    copy_packages(packages, site_packages)
    copy_kernels(site_packages)
    for folder in list(site_packages.rglob("__pycache__")):  # postinst compiles the files on the machine
        shutil.rmtree(folder)
    link = root / "usr/bin/bms-estimator"
    link.parent.mkdir()
    link.symlink_to(f"..{ENVIRONMENT.as_posix().removeprefix('/usr')}/bin/bms-estimator")
    write_documents(root / "usr/share/doc/bms-estimator", program.version)
    write_control(root / "DEBIAN", program.version, size_kib(root))
    subprocess.run(["chmod", "-R", "u=rwX,go=rX", root], check=True)
    for library in site_packages.rglob("*.so*"):  # libraries of a Debian package are not executable
        library.chmod(0o644)
    package = output / f"bms-estimator_{program.version}_{architecture()}.deb"
    subprocess.run(["dpkg-deb", "--root-owner-group", f"-Z{compression}", "--build", root, package], check=True)
    return package


def copy_kernels(site_packages: Path) -> None:
    """Copy the compiled kernels to the package, so that no machine compiles them. Compile those that are missing."""
    compile_kernels()
    if CACHE_FOLDER is None:
        sys.exit("no folder for compiled kernels can be written: set NUMBA_CACHE_DIR=FOLDER")
    version = f"py{sys.version_info.major}{sys.version_info.minor}"
    for file in (CACHE_FOLDER / COMPLETE_FILE, *CACHE_FOLDER.rglob(f"*.{version}.*.nbc")):
        target = site_packages / PACKAGE.name / "compiled" / file.relative_to(CACHE_FOLDER.parent)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, target)


def build_wheel(output: Path) -> Path:
    """Build the wheel of this checkout. Return its path."""
    command = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", output.resolve()]
    subprocess.run(command, cwd=PROJECT, check=True, stdout=subprocess.DEVNULL)
    return next(output.glob("*.whl"))


def require_locked(packages: list[Distribution]) -> None:
    """End with an error if an installed package has another version than in requirements.lock."""
    lock = (PROJECT / "requirements.lock").read_text(encoding="utf-8")
    locked = {(normalize(name), version) for name, version in re.findall(r"(?m)^([\w.-]+)==([^\s;\\]+)", lock)}
    for package in packages:
        if (normalize(package.name), package.version) not in locked:
            sys.exit(f"{package.name} {package.version} is not the version of requirements.lock: make venv")


def normalize(name: str) -> str:
    """Return the normalized form of the name of a Python package."""
    return re.sub(r"[-_.]+", "-", name).lower()


def architecture() -> str:
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


def write_control(folder: Path, version: str, installed_kib: int) -> None:
    """Write the package's description and its maintainer scripts."""
    folder.mkdir()
    minor = sys.version_info.minor
    (folder / "control").write_text(
        f"""\
Package: bms-estimator
Version: {version}
Architecture: {architecture()}
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
    purged = (places.SETTINGS, places.STATE, *map(places.drop_ins, (places.UNIT, places.TEMPLATE)))
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
    arguments = parser.parse_args()
    sys.stdout.write(f"{build(arguments.output, arguments.compression)}\n")
