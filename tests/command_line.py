"""Command line of the project, as a program and in the process of the test."""

import sys
from pathlib import Path

import pytest

from bms_estimator.cli.main import main

PROGRAM = Path(sys.executable).with_name("bms-estimator")


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int | str, str, str]:
    """Run the command line in this process. Return exit code, stdout and stderr."""
    with pytest.raises(SystemExit) as caught:
        main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return caught.value.code or 0, out, err
