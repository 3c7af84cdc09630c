"""Progress of the compilation at a first start, which takes a minute or two."""

import math
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext

from rich.console import Console
from rich.status import Status

from bms_estimator.kernels.compile_events import report_compilation

Show = Callable[[str], None]
"""Takes a line."""
LINE_S = 5.0
"""Minimum interval between two lines where lines stay visible [s]."""


@contextmanager
def show_compile_progress(say: Show | None = None) -> Iterator[None]:
    """Show meanwhile which kernel is compiled and how many there are; nothing where they are all in the cache.

    Args:
        say: Receives a line at intervals if stderr is not a terminal; else they go there.
    """
    console = Console(stderr=True)
    shown = _status_line(console) if console.is_terminal else nullcontext(_now_and_then(say or _to_stderr))
    with shown as show, _interrupted_between() as check:

        def tell(kernel: str, number: int, most: int) -> None:
            check()
            show(f"compiling kernels, once: {number}/{most} {kernel}")

        with report_compilation(tell):
            yield


@contextmanager
def _status_line(console: Console) -> Iterator[Show]:
    """One line that is gone in the end."""
    status = Status("", console=console)

    def show(text: str) -> None:
        status.update(text)
        status.start()

    try:
        yield show
    finally:
        status.stop()


def _now_and_then(say: Show) -> Show:
    said_s = -math.inf

    def show(text: str) -> None:
        nonlocal said_s
        if time.monotonic() - said_s >= LINE_S:
            said_s = time.monotonic()
            say(text)

    return show


@contextmanager
def _interrupted_between() -> Iterator[Callable[[], None]]:
    """Make SIGINT wait for the next kernel: an exception inside the compiler is lost, and the compiler fails.

    Raises:
        KeyboardInterrupt: SIGINT arrived, and no kernel raised it.
    """
    came = False

    def note(*_: object) -> None:
        nonlocal came
        came = True

    def check() -> None:
        if came:
            raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, note)
    try:
        yield check
    finally:
        signal.signal(signal.SIGINT, before)
    check()


def _to_stderr(text: str) -> None:
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()
