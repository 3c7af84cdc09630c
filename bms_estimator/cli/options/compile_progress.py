"""Progress line on stderr while kernels compile.

A first start takes a minute or two. Later starts load the kernels from the cache.
"""

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

from numba.core import event
from rich.console import Console
from rich.progress import Progress, TextColumn, TimeElapsedColumn

COMPILE_TEXT = "compiling the kernels; this takes a minute or two, and later starts use the cache"
"""Text of the progress line."""


@contextmanager
def show_compile_progress(report: Callable[[str], object] | None = None) -> Iterator[None]:
    """Show a line with the elapsed time as soon as a kernel compiles. No line appears if all kernels are cached.

    Args:
        report: Called with the line, without the elapsed time, if stderr is not a terminal; default: write to stderr.

    Raises:
        KeyboardInterrupt: SIGINT arrived. The error is raised only at the next kernel, because an exception inside the
            compiler is lost.
    """
    console = Console(stderr=True)
    with ExitStack() as stack:

        def show() -> None:
            if console.is_terminal:
                progress = Progress(TextColumn(COMPILE_TEXT), TimeElapsedColumn(), console=console, transient=True)
                stack.enter_context(progress).add_task("")
            else:
                (report or _to_stderr)(COMPILE_TEXT)

        listener = _Listener(show)
        previous_handler = signal.signal(signal.SIGINT, listener.on_interrupt)
        stack.callback(signal.signal, signal.SIGINT, previous_handler)
        with event.install_listener("numba:compile", listener):
            yield
    listener.raise_if_interrupted()


class _Listener(event.Listener):
    """Listener for functions that numba compiles. Cached functions cause no event."""

    def __init__(self, show: Callable[[], None]) -> None:
        self._show, self._is_shown, self._interrupted = show, False, False

    def on_interrupt(self, *_: object) -> None:
        """Remember SIGINT."""
        self._interrupted = True

    def raise_if_interrupted(self) -> None:
        """Raise KeyboardInterrupt after SIGINT."""
        if self._interrupted:
            raise KeyboardInterrupt

    def on_start(self, _: event.Event) -> None:
        """Raise KeyboardInterrupt after SIGINT; otherwise show the line, once."""
        self.raise_if_interrupted()
        if not self._is_shown:
            self._is_shown = True
            self._show()

    def on_end(self, _: event.Event) -> None:
        """Do nothing: the end of a compilation is not needed."""


def _to_stderr(text: str) -> None:
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()
