"""Help texts, and suggestions for misspelled commands."""

import re
import subprocess
import sys

import pytest

from bms_estimator.cli.fleet.commands import COMMANDS as FLEET_COMMANDS
from bms_estimator.cli.main import COMMANDS
from tests.command_line import PROGRAM, run

SLOW_PACKAGES = {"aiohttp", "aiomqtt", "numba", "numpy", "pydantic", "scipy", "serial"}
"""Packages that the list of commands must not import."""


@pytest.mark.parametrize("words", [[], *([name] for name in COMMANDS), *(["fleet", name] for name in FLEET_COMMANDS)])
def test_h_is_a_short_form_of_help(capsys: pytest.CaptureFixture[str], words: list[str]) -> None:
    assert run(capsys, *words, "-h") == run(capsys, *words, "--help")


@pytest.mark.parametrize(
    ("words", "similar"), [(["replya"], "replay"), (["fleet", "wroker"], "worker"), (["config", "chek"], "check")]
)
def test_a_similar_command_is_suggested(capsys: pytest.CaptureFixture[str], words: list[str], similar: str) -> None:
    code, out, err = run(capsys, *words)
    assert (code, out) == (2, "")
    assert f"Did you mean '{similar}'?" in err


def test_the_list_of_commands_imports_no_slow_package() -> None:
    command = [sys.executable, "-X", "importtime", PROGRAM, "--help"]
    log = subprocess.run(command, capture_output=True, text=True, check=True).stderr
    imported = set(re.findall(r"\|\s+(\w+)[.\w]*$", log, re.MULTILINE))
    assert "typer" in imported
    assert imported & SLOW_PACKAGES == set()
