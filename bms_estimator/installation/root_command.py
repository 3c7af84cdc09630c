"""Command that runs this program as root."""

import sys
from pathlib import Path

from bms_estimator.installation import paths


def root_command(*arguments: str | Path) -> list[str]:
    """Return the command that runs this program as root, with its full path, because sudo does not search a virtual environment."""
    program = Path(sys.executable).with_name(paths.NAME)
    return ["sudo", str(program), *map(str, arguments)]
