"""Child processes that end with their parent, even after a SIGKILL."""

import ctypes
import os
import signal
import sys
from collections.abc import Callable
from functools import partial

PR_SET_PDEATHSIG = 1
"""Option number from linux/prctl.h."""
_prctl = ctypes.CDLL(None).prctl if sys.platform == "linux" else None


def ends_with_us() -> Callable[[], None] | None:
    """Return a ``preexec_fn`` with which the kernel sends the child SIGTERM when its parent thread ends.

    Only the kernel can do this after a SIGKILL of the parent. The child must be started from the main thread. The result is
    None on systems other than Linux.
    """
    return partial(end_with, os.getpid()) if sys.platform == "linux" else None


def end_with(parent: int) -> None:
    """Let the kernel send this process SIGTERM when its parent thread ends; no effect on systems other than Linux.

    Args:
        parent: Process number of the parent.
    """
    if _prctl is not None:
        _prctl(PR_SET_PDEATHSIG, ctypes.c_ulong(signal.SIGTERM))
        if os.getppid() != parent:  # the parent ended before the request
            os._exit(1)
