"""Command that runs this program as root."""

import sys
from pathlib import Path

from bms_estimator.installation import places


def root_command(*arguments: str | Path) -> list[str]:
    """Return the command that runs this program as root, with its full path, because sudo does not search a virtual environment."""
    program = Path(sys.executable).with_name(places.NAME)
    return ["sudo", str(program), *map(str, arguments)]
