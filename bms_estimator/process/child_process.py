"""Child processes that end with their parent, even after a SIGKILL."""

import ctypes
import os
import signal
import sys
from collections.abc import Callable

PR_SET_PDEATHSIG = 1
"""Option number from linux/prctl.h."""


def ends_with_us() -> Callable[[], None] | None:
    """Return a ``preexec_fn`` with which the kernel sends the child SIGTERM when its parent thread ends.

    Only the kernel can do this after a SIGKILL of the parent. The child must be started from the main thread. The result is
    None on systems other than Linux.
    """
    if sys.platform != "linux":
        return None
    prctl, parent = ctypes.CDLL(None).prctl, os.getpid()

    def request_signal() -> None:
        prctl(PR_SET_PDEATHSIG, ctypes.c_ulong(signal.SIGTERM))
        if os.getppid() != parent:  # the parent ended before the request
            os._exit(1)

    return request_signal
