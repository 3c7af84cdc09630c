"""A child that does not outlive its parent, however that ends."""

import ctypes
import os
import signal
import sys
from collections.abc import Callable

PR_SET_PDEATHSIG = 1
"""Option number from linux/prctl.h."""


def ends_with_us() -> Callable[[], None] | None:
    """Return a ``preexec_fn`` with which the kernel sends the child SIGTERM when its parent thread ends.

    Only the kernel can do this after a SIGKILL of the parent. Start the child from the main thread. None on systems other than
    Linux.
    """
    if sys.platform != "linux":
        return None
    prctl, parent = ctypes.CDLL(None).prctl, os.getpid()

    def ask() -> None:
        prctl(PR_SET_PDEATHSIG, ctypes.c_ulong(signal.SIGTERM))
        if os.getppid() != parent:  # killed before it was requested
            os._exit(1)

    return ask
