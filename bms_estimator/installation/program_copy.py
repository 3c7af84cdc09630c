"""Copy of this program and the packages that it requires, in a separate virtual environment; and files that a service can read."""

import re
import shutil
import sys
from collections.abc import Iterable, Iterator
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from importlib.util import cache_from_source
from pathlib import Path

from pydantic import BaseModel

from bms_estimator.model.config_file import read_toml
from bms_estimator.model.errors import UserError
from bms_estimator.settings.pack import Settings

HIDDEN_FOLDERS = (Path("/home"), Path("/root"), Path("/run/user"), Path("/tmp"), Path("/var/tmp"))  # noqa: S108
"""Folders that the unit hides from the service by ProtectHome and PrivateTmp."""


def is_hidden_from_services(path: Path) -> bool:
    """Return True if the service cannot see a file."""
    return any(path.is_relative_to(folder) for folder in HIDDEN_FOLDERS)


def named_files(pack: Path) -> list[Path]:
    """Return the files that a pack's settings name and that must be copied with the pack file.

    The files are in the folder of the pack file. A name without such a file may be a systemd credential or a generic cell.

    Args:
        pack: Settings file of the pack.

    Raises:
        UserError: The settings are invalid, or a file is in a folder that the service cannot see.
    """
    files = []
    for key, name in _paths_in(read_toml(pack, Settings)):
        if name.is_absolute():
            if is_hidden_from_services(name.resolve()):
                raise UserError(
                    f"{pack}: {key} = {name}: the service cannot read this folder; "
                    f"move the file beside {pack.name}, and write {key} = {name.name}"
                )
        elif (file := pack.parent / name).is_file():
            if len(name.parts) > 1:
                raise UserError(f"{pack}: {key} = {name}: move the file beside {pack.name}, and give only its name")
            files.append(file)
    return list(dict.fromkeys(files))


def _paths_in(settings: Settings) -> Iterator[tuple[str, Path]]:
    """Yield key and path of each file that settings may name."""
    yield "pack.cell", Path(settings.pack.cell)
    for name in Settings.model_fields:
        section = getattr(settings, name)
        if isinstance(section, BaseModel):
            yield from _paths_of_section(name, section)


def _paths_of_section(prefix: str, section: BaseModel) -> Iterator[tuple[str, Path]]:
    """Yield key and path of each file that a section or one of its subsections may name."""
    for key in type(section).model_fields:
        value = getattr(section, key)
        if isinstance(value, Path):
            yield f"{prefix}.{key}", value
        elif isinstance(value, BaseModel):
            yield from _paths_of_section(f"{prefix}.{key}", value)


DISTRIBUTION = "bms_estimator"
PACKAGE = Path(__file__).parents[1]
"""Folder of this program's package."""
PYTHON = f"python{sys.version_info.major}.{sys.version_info.minor}"
SITE_PACKAGES = Path("lib", PYTHON, "site-packages")
"""Folder of the packages in a virtual environment."""
CREATOR = "creator = bms-estimator install"
"""Line of pyvenv.cfg that marks a copy."""
SCRIPT = """#!{python}
import sys
from bms_estimator.cli.main import main
sys.exit(main())
"""
ELF_MAGIC = b"\x7fELF"
"""First bytes of a program for Linux."""
_REQUIREMENT = re.compile(r"([\w.-]+)\s*(?:\[([^]]*)\])?")
_EXTRA = re.compile(r"extra\s*==\s*['\"]([\w.-]+)['\"]")


def is_program_copy(folder: Path) -> bool:
    """Return True if the folder is an environment that ``create_environment`` made."""
    config = folder / "pyvenv.cfg"
    return config.is_file() and CREATOR in config.read_text(encoding="utf-8").splitlines()


def system_python() -> Path:
    """Return a Python of this version that services can run.

    Raises:
        UserError: No Python of this version is outside of home folders.
    """
    for folder in (Path(sys.base_prefix, "bin"), Path("/usr/bin"), Path("/usr/local/bin")):
        python = folder / PYTHON
        if python.exists() and not is_hidden_from_services(python.resolve()):
            return python
    raise UserError(
        f"{sys.base_prefix}: a service cannot run a Python in a home folder; "
        f"install {PYTHON} for all users, or create the environment with the system's python3"
    )


def create_environment(folder: Path, *, installed_as: Path, python: Path) -> Path:
    """Create a virtual environment without packages, and a script that starts this program.

    Args:
        folder: Folder of the environment, which is created.
        installed_as: Absolute path under which the environment will be used.
        python: Interpreter of the environment.

    Returns:
        Folder for the packages.
    """
    site_packages = folder / SITE_PACKAGES
    site_packages.mkdir(parents=True)
    (folder / "bin").mkdir()
    (folder / "bin/python3").symlink_to(python)
    (folder / "pyvenv.cfg").write_text(f"home = {python.parent}\ninclude-system-site-packages = false\n{CREATOR}\n")
    script = folder / "bin/bms-estimator"
    script.write_text(SCRIPT.format(python=installed_as / "bin/python3"))
    script.chmod(0o755)
    return site_packages


def copy_program(target: Path, *, installed_as: Path, python: Path) -> None:
    """Copy this program, and the packages that it requires and can use, to a virtual environment.

    Args:
        target: Folder of the environment. An earlier copy is replaced.
        installed_as: Absolute path under which the environment will be used; different from ``target`` in an image.
        python: Interpreter of the environment.

    Raises:
        UserError: The folder exists, and is not a copy of this program.
    """
    if target.exists() and not is_program_copy(target):
        raise UserError(
            f"{target}: exists, and was not created by this command; run {target}/bin/bms-estimator install"
        )
    new = target.with_name(f".{target.name}.new")
    shutil.rmtree(new, ignore_errors=True)
    site_packages = create_environment(new, installed_as=installed_as, python=python)
    program = distribution(DISTRIBUTION)
    extras = program.metadata.get_all("Provides-Extra") or []
    copy_packages(required_packages(program, extras), site_packages)
    _copy_own_package(site_packages)
    shutil.rmtree(target, ignore_errors=True)
    new.rename(target)


def required_packages(program: Distribution, extras: Iterable[str]) -> list[Distribution]:
    """Return the installed packages that a program requires, directly or indirectly, sorted by name.

    Args:
        program: The program.
        extras: Extras of the program whose installed packages are included.
    """
    packages: dict[str, Distribution] = {}
    pending = list(_requirements(program, set(extras)))
    seen = set()
    while pending:
        name, extras_of_package = requirement = pending.pop()
        if requirement in seen:
            continue
        seen.add(requirement)
        try:
            package = distribution(name)
        except PackageNotFoundError:  # required on another platform, or by an extra that is not installed
            continue
        packages[package.name] = package
        pending += _requirements(package, set(extras_of_package))
    return [packages[name] for name in sorted(packages)]


def _requirements(package: Distribution, extras: set[str]) -> Iterator[tuple[str, frozenset[str]]]:
    """Yield name and extras of each requirement that a package has with the given extras."""
    for line in package.requires or []:
        requirement, _, marker = line.partition(";")
        extra = _EXTRA.search(marker)
        match = _REQUIREMENT.match(requirement)
        if match and (extra is None or extra[1] in extras):
            yield match[1], frozenset(part.strip() for part in (match[2] or "").split(",") if part.strip())


def copy_packages(packages: Iterable[Distribution], site_packages: Path) -> None:
    """Copy the files of installed packages to the same places in another environment.

    Programs such as nats-server and compiled Python files are copied. Scripts are not, because they name their interpreter.
    """
    for package in packages:
        for file in package.files or []:
            source = Path(str(file.locate()))
            if "__pycache__" in file.parts or (".." in file.parts and not _is_program(source)):
                continue
            _copy(source, site_packages / file)


def _is_program(path: Path) -> bool:
    """Return True if a file outside of the folder of packages is a program that runs without an interpreter."""
    if path.parent.name != "bin" or not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(ELF_MAGIC)) == ELF_MAGIC


def _copy_own_package(site_packages: Path) -> None:
    """Copy this program's package and its metadata. A package in a checkout is not among its distribution's files."""
    shutil.copytree(PACKAGE, site_packages / PACKAGE.name)
    for file in distribution(DISTRIBUTION).files or []:
        if file.parts[0].endswith(".dist-info"):
            _copy(Path(str(file.locate())), site_packages / file)


def _copy(source: Path, target: Path) -> None:
    """Copy a file with its modification time. Also copy the compiled file of a Python file, which is valid only for this time."""
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy2(source, target)
    if source.suffix == ".py":
        compiled, copied = (Path(cache_from_source(str(path))) for path in (source, target))
        if compiled.exists():
            copied.parent.mkdir(exist_ok=True)
            shutil.copy2(compiled, copied)
