"""Machine on which the service is installed: root directory, files, users and systemd."""

import errno
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from bms_estimator.installation import paths
from bms_estimator.model.errors import UserError


def root_command(*arguments: str | Path) -> list[str]:
    """Return the command that runs this program as root, with its full path, because sudo does not search a virtual environment."""
    program = Path(sys.executable).with_name(paths.NAME)
    return ["sudo", str(program), *map(str, arguments)]


_LINK_ERROR = "{}: is a symbolic link, which may lead to another user's file; replace it with the file"


@dataclass(frozen=True)
class Machine:
    """Machine with a root directory. ``/`` is this machine; any other directory is a system image, which does not run."""

    root: Path = Path("/")

    def path(self, name: str | Path) -> Path:
        """Return the path that a file of the machine has for this process.

        Args:
            name: Absolute path of the file on the machine.

        Raises:
            UserError: A symbolic link to a folder leads out of the root directory. On the machine, the same link leads
                to another folder.
        """
        path = self.root / str(name).lstrip("/")
        folder = path if path.is_dir() else path.parent
        if not folder.resolve().is_relative_to(self.root):
            raise UserError(f"{path}: a symbolic link leads out of {self.root}; replace it by a relative link")
        return path

    @property
    def has_running_systemd(self) -> bool:
        """True if systemd runs this machine, so that a service can be started."""
        return self.root == Path("/") and Path("/run/systemd/system").is_dir()

    @property
    def lacks_systemd(self) -> bool:
        """True for this machine if systemd does not run it, as in a container; False for a system image."""
        return self.root == Path("/") and not self.has_running_systemd

    def run(self, program: str, *arguments: str, root_option: str = "--root") -> None:
        """Run a program that changes the machine.

        Args:
            program: Name of the program.
            arguments: Its arguments.
            root_option: Option of the program for the root directory of an image.

        Raises:
            UserError: The program is missing or fails.
        """
        run([program, *([] if self.root == Path("/") else [f"{root_option}={self.root}"]), *arguments])

    def read(self, name: str | Path) -> bytes | None:
        """Return the content of a file; None if there is no file.

        Args:
            name: Absolute path of the file on the machine.

        Raises:
            UserError: The path is a symbolic link, or cannot be read.
        """
        path = self.path(name)
        return read_file(path) if path.is_symlink() or path.exists() else None

    def write(self, name: str | Path, content: bytes, *, mode: int = 0o644, group: int = 0) -> None:
        """Write a file that belongs to root. Create its folder; replace an existing file atomically.

        Args:
            name: Absolute path of the file on the machine.
            content: Content of the file.
            mode: Permissions.
            group: Id of the group.

        Raises:
            UserError: The path is a symbolic link, or cannot be written.
        """
        path = self.path(name)
        if path.is_symlink():
            raise UserError(_LINK_ERROR.format(path))
        new = path.with_name(f".{path.name}.new")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            new.unlink(missing_ok=True)
            with open(new, "xb", opener=_open_private) as file:
                file.write(content)
                os.fchown(file.fileno(), 0, group)
                os.fchmod(file.fileno(), mode)
            new.replace(path)
        except OSError as error:
            raise UserError(f"{path}: cannot be written: {error.strerror}") from None

    def group_id(self, name: str) -> int | None:
        """Return the id of a group of the machine; None if there is no such group."""
        file = self.path("/etc/group")
        lines = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
        return next((int(line.split(":")[2]) for line in lines if line.startswith(f"{name}:")), None)


def read_file(path: Path) -> bytes:
    """Return the content of a file.

    Raises:
        UserError: The path is a symbolic link, or cannot be read.
    """
    try:
        with open(path, "rb", opener=_open_without_links) as file:
            return file.read()
    except OSError as error:
        raise UserError(
            _LINK_ERROR.format(path) if error.errno == errno.ELOOP else f"{path}: cannot be read: {error.strerror}"
        ) from None


def _open_without_links(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NOFOLLOW)


def _open_private(path: str, flags: int) -> int:
    return os.open(path, flags, 0o600)


def run(command: Sequence[str]) -> None:
    """Run a program.

    Raises:
        UserError: The program is missing or fails.
    """
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - only programs of the system
    except FileNotFoundError:
        raise UserError(f"{command[0]} is not installed: the service needs a Linux system with systemd") from None
    if done.returncode:
        reason = done.stderr.strip() or f"exit code {done.returncode}"
        raise UserError(f"{' '.join(command)}: {reason}")


def tree(folder: Path) -> Iterator[Path]:
    """Yield a folder and all files and folders in it, without following symbolic links."""
    yield folder
    for parent, folders, files in os.walk(folder):
        yield from (Path(parent, name) for name in (*folders, *files))
