"""Versions of builds, of this project and of copies with another history."""

import subprocess
import sys
from pathlib import Path

from tests.deploy.core_environment import PROJECT

COMMANDS = f"""
hatchling() {{ {sys.executable} -m hatchling "$@"; }}
version() {{ hatchling version; }}
commit() {{
    git init --quiet
    git add --all
    git -c user.name=test -c user.email=test@localhost commit --quiet --allow-empty --message=change
}}
"""
"""Shell functions: the build program; print the version of a build of the folder; commit the folder, without a change an empty commit."""


def versions(folder: Path, script: str) -> list[str]:
    """Run a shell script in ``folder``. Return the versions that it prints."""
    command = ["bash", "-ec", COMMANDS + script]
    return subprocess.run(command, cwd=folder, stdout=subprocess.PIPE, text=True, check=True).stdout.split()


def link_project(folder: Path) -> Path:
    """Create ``folder`` with links to the files of this project, without its history. Return ``folder``."""
    folder.mkdir()
    for path in PROJECT.iterdir():
        if path.name != ".git":
            (folder / path.name).symlink_to(path)
    return folder
