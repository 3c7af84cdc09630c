"""Completion in the shell: commands, options and names of cells, ports and protocols, as bash itself completes them."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.command_line import PROGRAM

COMPLETE = """\
source ~/.bash_completions/bms-estimator.sh
COMP_WORDS=("$@")
COMP_CWORD=$(($# - 1))
{function} bms-estimator
printf '%s\\n' "${{COMPREPLY[@]}}"
"""
"""Script that completes its last argument with the installed function, as bash does when Tab is pressed."""


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Return an environment with an empty home folder and the program in the search path."""
    home = tmp_path_factory.mktemp("home")
    return os.environ | {"HOME": str(home), "PATH": f"{PROGRAM.parent}:{os.environ['PATH']}"}


@pytest.fixture(scope="module")
def bash_home(environment: dict[str, str]) -> dict[str, str]:
    """Install the completion from within bash, and return the environment."""
    install(environment, "bash")
    return environment


def install(environment: dict[str, str], shell: str) -> None:
    """Install the completion as a user of ``shell`` does.

    ``; true`` prevents the shell from replacing itself by the program, which then could not recognize the shell.
    """
    path = shutil.which(shell)
    if path is None:
        pytest.skip(f"{shell} is not installed (apt-get install {shell})")
    subprocess.run([path, "-c", "bms-estimator --install-completion; true"], env=environment, check=True)


def complete(environment: dict[str, str], *words: str) -> list[str]:
    """Return what bash offers for the last word of the command line ``bms-estimator WORDS``."""
    home = Path(environment["HOME"])
    assert "source" in (home / ".bashrc").read_text(encoding="utf-8")
    completion = (home / ".bash_completions" / "bms-estimator.sh").read_text(encoding="utf-8")
    function = completion.partition("(")[0].strip()
    command = ["bash", "--norc", "-c", COMPLETE.format(function=function), "bash", "bms-estimator", *words]
    return subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout.split()


def test_bash_completes_commands(bash_home: dict[str, str]) -> None:
    assert complete(bash_home, "re") == ["replay", "record", "report", "restore"]


def test_bash_completes_options(bash_home: dict[str, str]) -> None:
    assert complete(bash_home, "ports", "--pr") == ["--probe"]


def test_bash_completes_cells_of_a_battery(bash_home: dict[str, str]) -> None:
    assert complete(bash_home, "simulate", "--cell", "l") == ["lco", "lfp", "lmo", "lto", "leaf"]
    assert complete(bash_home, "adapt", "run.csv", "--cell", "pem") == []


@pytest.mark.thorough
def test_bash_completes_fuel_cells_where_they_are_allowed(bash_home: dict[str, str]) -> None:
    assert complete(bash_home, "replay", "run.csv", "--cell", "pem") == ["pem_30w"]


def test_bash_completes_protocols(bash_home: dict[str, str]) -> None:
    assert complete(bash_home, "simulate", "--protocol", "j") == ["junctek", "jbd", "jk", "jk-pb"]


def test_fish_completes_commands(environment: dict[str, str]) -> None:
    install(environment, "fish")
    command = ["fish", "-c", "complete -C 'bms-estimator rep'"]
    completed = subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout
    assert completed.startswith("replay\t")


def test_zsh_finds_the_installed_completion(environment: dict[str, str]) -> None:
    install(environment, "zsh")
    command = ["zsh", "-i", "-c", "print $_comps[bms-estimator]"]
    assert subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout.split()
