"""The command line: as a program, and within the test's own process."""

import sys
from pathlib import Path

import pytest

from bms_estimator.cli.main import main

PROGRAM = Path(sys.executable).with_name("bms-estimator")


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int | str, str, str]:
    """Exit code, stdout, stderr of the command line."""
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return ended.value.code or 0, out, err
