"""Errors of ``run`` and of the command line at the start: one line for each, code 2, no traceback."""

import os
import subprocess
from pathlib import Path

import pytest

from bms_estimator.cli.main import COMMANDS
from bms_estimator.version import __version__
from tests.command_line import PROGRAM, error, run

OUTPUTS = [
    (("config", "show"), ""),
    pytest.param(("--version",), "", marks=pytest.mark.thorough),
    (("ports", "/dev/null"), ""),
    pytest.param(("config", "show"), "1", marks=pytest.mark.thorough),
    pytest.param(("--version",), "1", marks=pytest.mark.thorough),
    pytest.param(("ports", "/dev/null"), "1", marks=pytest.mark.thorough),
]
"""Commands that write in different ways, and values of PYTHONUNBUFFERED."""


def test_missing_pack_file_is_an_error(tmp_path, capsys):
    message = f"error: {tmp_path / 'none.toml'}: cannot be read: No such file or directory\n"
    assert run(capsys, "run", tmp_path / "none.toml") == (2, "", message)


def test_existing_capture_is_not_overwritten(tmp_path, capsys):
    pack, capture = tmp_path / "pack.toml", tmp_path / "kept.bms"
    pack.write_text('[sensor]\nport = "/dev/none"\n')
    capture.write_bytes(b"kept")
    message = f"error: {capture}: exists already; a capture is never overwritten\n"
    assert run(capsys, "run", pack, "--record", capture) == (2, "", message)
    assert capture.read_bytes() == b"kept"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"[pack\n", "not valid TOML"),
        (b"[pack]\nseries = 2\nseries = 3\n", "not valid TOML"),
        (b"[pack]\nname = \xff\xfe\n", "not valid TOML"),
        (b"[pack]\nseries = 0\n", "pack.series = 0"),
        (b'[pack]\ncell = "none.toml"\n', "none.toml"),
    ],
)
def test_invalid_pack_file_is_an_error(content, message, tmp_path, capsys):
    pack = tmp_path / "pack.toml"
    pack.write_bytes(content)
    code, out, err = run(capsys, "run", pack)
    assert (code, out) == (2, "")
    assert err.count("\n") == 1
    assert err.startswith("error: ")
    assert message in err


def test_invalid_broker_url_is_an_error(tmp_path, capsys):
    pack = tmp_path / "pack.toml"
    pack.write_text('[sensor]\nport = "/dev/none"\n')
    assert "error: --mqtt nonsense: must be" in error(run(capsys, "run", pack, "--mqtt", "nonsense"))


@pytest.mark.parametrize("options", [("--port", "/dev/none"), ("--record", "new.bms"), ("--view",)])
def test_options_of_one_board_are_rejected_for_several_packs(options, tmp_path, capsys):
    packs = [tmp_path / "one.toml", tmp_path / "two.toml"]
    for pack in packs:
        pack.write_text("[pack]\n")
    assert run(capsys, "run", *packs, *options) == (2, "", "error: --port, --record and --view require a single pack\n")


def test_help_lists_all_commands_and_version_prints_the_version(capsys):
    code, out, _ = run(capsys, "--help")
    assert code == 0
    assert [name for name in COMMANDS if f" {name} " not in out] == []
    assert run(capsys, "--version") == (0, f"bms-estimator {__version__}\n", "")
    assert "No such command 'nosuch'" in error(run(capsys, "nosuch"))


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_can_be_imported_and_has_help(command, capsys):
    code, out, err = run(capsys, command, "--help")
    assert (code, err) == (0, "")
    assert f"bms-estimator {command} " in out


@pytest.mark.parametrize(("arguments", "unbuffered"), OUTPUTS)
def test_unwritable_stdout_is_reported(arguments, unbuffered):
    environment = os.environ | {"PYTHONUNBUFFERED": unbuffered}
    with Path("/dev/full").open("w") as full:
        process = subprocess.run(
            [PROGRAM, *arguments], stdout=full, stderr=subprocess.PIPE, text=True, env=environment, check=False
        )
    assert process.stderr == "error: cannot write: No space left on device\n"
    assert process.returncode == 1


@pytest.mark.parametrize(("arguments", "unbuffered"), OUTPUTS)
def test_closed_stdout_ends_quietly(arguments, unbuffered):
    environment = os.environ | {"PYTHONUNBUFFERED": unbuffered}
    read, write = os.pipe()
    os.close(read)
    process = subprocess.run(
        [PROGRAM, *arguments], stdout=write, stderr=subprocess.PIPE, text=True, env=environment, check=False
    )
    os.close(write)
    assert (process.returncode, process.stderr) == (1, "")
