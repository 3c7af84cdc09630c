"""What is being compiled, for people: a first start takes a minute or two."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.status import Status

from bms_estimator.kernels.compiling import compiling_told

LINE_S = 5.0
"""Where lines stay there is one no more often than this [s]."""


@contextmanager
def compiling_shown(say: Callable[[str], None] | None = None) -> Iterator[None]:
    """Show meanwhile which kernel is compiled and how many there are; nothing where they are all in the cache.

    Args:
        say: Takes a line now and then where stderr is no terminal; else they go there.
    """
    console = Console(stderr=True)
    if console.is_terminal:
        with _shown_on(console):
            yield
    else:
        with _said(say or _to_stderr):
            yield


@contextmanager
def _shown_on(console: Console) -> Iterator[None]:
    """In one line that is gone in the end."""
    status = Status("", console=console)

    def tell(kernel: str, number: int, most: int) -> None:
        status.update(_text(kernel, number, most))
        status.start()

    try:
        with compiling_told(tell):
            yield
    finally:
        status.stop()


@contextmanager
def _said(say: Callable[[str], None]) -> Iterator[None]:
    said_s = -LINE_S

    def tell(kernel: str, number: int, most: int) -> None:
        nonlocal said_s
        if time.monotonic() - said_s >= LINE_S:
            said_s = time.monotonic()
            say(_text(kernel, number, most))

    with compiling_told(tell):
        yield


def _text(kernel: str, number: int, most: int) -> str:
    return f"compiling kernels, once: {number}/{most} {kernel}"


def _to_stderr(text: str) -> None:
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()
