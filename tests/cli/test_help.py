"""Help texts, and suggestions for misspelled commands."""

import re
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest
from rich.text import Text

from bms_estimator.cli.fleet.commands import COMMANDS as FLEET_COMMANDS
from bms_estimator.cli.lazy_group import import_command
from bms_estimator.cli.main import COMMANDS
from tests.command_line import PROGRAM, run

SLOW_PACKAGES = {"aiohttp", "aiomqtt", "numba", "numpy", "pydantic", "scipy", "serial"}
"""Packages that the list of commands must not import."""


def help_texts(command: Any) -> Iterator[str]:
    """Yield the help texts of the options and arguments of a command, and of its subcommands."""
    yield from (text for parameter in command.params if (text := getattr(parameter, "help", None)))
    for subcommand in getattr(command, "commands", {}).values():
        yield from help_texts(subcommand)


@pytest.mark.parametrize("words", [[], *([name] for name in COMMANDS), *(["fleet", name] for name in FLEET_COMMANDS)])
def test_h_is_a_short_form_of_help(capsys: pytest.CaptureFixture[str], words: list[str]) -> None:
    assert run(capsys, *words, "-h") == run(capsys, *words, "--help")


def test_no_bracket_of_a_help_text_is_read_as_markup() -> None:
    commands = [import_command(name, entry) for name, entry in [*COMMANDS.items(), *FLEET_COMMANDS.items()]]
    texts = [text for command in commands for text in help_texts(command)]
    assert len(texts) > 100
    assert [text for text in texts if Text.from_markup(text).plain != text.replace("\\[", "[")] == []


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
