"""A child that does not outlive its parent, however that ends."""

import ctypes
import os
import signal
import sys
from collections.abc import Callable

PR_SET_PDEATHSIG = 1
"""Option number from linux/prctl.h."""


def ends_with_us() -> Callable[[], None] | None:
    """For ``preexec_fn``: the kernel sends the child SIGTERM when the thread that has started it is no more.

    SIGKILL of this process is an end that nobody else can pass on. Start the child from the main thread. None where the
    kernel knows no such thing, as only Linux does.
    """
    if sys.platform != "linux":
        return None
    prctl, parent = ctypes.CDLL(None).prctl, os.getpid()

    def ask() -> None:
        prctl(PR_SET_PDEATHSIG, ctypes.c_ulong(signal.SIGTERM))
        if os.getppid() != parent:  # killed before it was asked
            os._exit(1)

    return ask
