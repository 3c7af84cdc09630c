"""Command line of the project, as a program and in the process of the test."""

import asyncio
import contextlib
import sys
from asyncio.subprocess import DEVNULL, PIPE, Process
from collections.abc import AsyncIterator, Mapping
from pathlib import Path
from typing import IO

import pytest

from bms_estimator.cli.main import main

PROGRAM = Path(sys.executable).with_name("bms-estimator")


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int | str, str, str]:
    """Run the command line in this process. Return exit code, stdout and stderr, without the output before."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as caught:
        main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return caught.value.code or 0, out, err


def error(result: tuple[int | str, str, str]) -> str:
    """Return the text on stderr of a command that ended with an error."""
    assert result[0] == 2
    return result[2]


@contextlib.asynccontextmanager
async def running_program(
    *command: object,
    stdout: int | IO[bytes] = PIPE,
    stderr: int | IO[bytes] | IO[str] | None = PIPE,
    folder: Path | None = None,
    env: Mapping[str, str] | None = None,
) -> AsyncIterator[Process]:
    """Start a program without input in ``folder``, and kill it at the end."""
    process = await asyncio.create_subprocess_exec(
        *map(str, command), stdin=DEVNULL, stdout=stdout, stderr=stderr, cwd=folder, env=env
    )
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.wait()
