"""Progress bar on stderr while kernels compile.

A first start compiles for 22 s on two idle cores. Later starts load the kernels from the cache.

Bar with label, percentage and time left, in the same form for all commands.
"""

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

from numba.core import event
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from bms_estimator.numba_cache import count_cached_kernels, count_kernels

BAR_WIDTH = 24
"""Width of the bar [characters]. With a long label, the line fits into 80 columns."""


def new_bar(console: Console) -> Progress:
    """Return a bar that disappears at its end. It writes nothing if the console is not a terminal."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(BAR_WIDTH),
        TaskProgressColumn(),
        TimeRemainingColumn(),
    )
    return Progress(*columns, console=console, disable=not console.is_terminal, transient=True)


COMPILE_TEXT = "compiling the kernels; this takes up to a minute, and later starts use the cache"
"""Line on a stderr that is not a terminal."""
COMPILE_LABEL = "compiling kernels (first start only)"
"""Label of the bar."""


@contextmanager
def show_compile_progress(report: Callable[[str], object] | None = None) -> Iterator[None]:
    """Show a bar with the time left as soon as a kernel compiles. No bar appears if all kernels are cached.

    Args:
        report: Called with ``COMPILE_TEXT`` if stderr is not a terminal; default: write to stderr.

    Raises:
        KeyboardInterrupt: SIGINT arrived. The error is raised only at the next kernel, because an exception inside the
            compiler is lost.
    """
    console = Console(stderr=True)
    with ExitStack() as stack:

        def show() -> None:
            if console.is_terminal:
                listener.on_kernel = _CompileBar(stack.enter_context(new_bar(console))).update
            else:
                (report or _to_stderr)(COMPILE_TEXT)

        listener = CompileListener(show)
        previous_handler = signal.signal(signal.SIGINT, listener.on_interrupt)
        stack.callback(signal.signal, signal.SIGINT, previous_handler)
        with event.install_listener("numba:compile", listener):
            yield
    listener.raise_if_interrupted()


class CompileListener(event.Listener):
    """Listener for functions that numba compiles. Cached functions cause no event."""

    def __init__(self, show: Callable[[], None]) -> None:
        self._show, self._is_shown, self._interrupted = show, False, False
        self.on_kernel: Callable[[], None] = lambda: None
        """Function that is called before each kernel is compiled. ``show`` may replace it, for example to draw a bar."""

    def on_interrupt(self, *_: object) -> None:
        """Store that SIGINT arrived."""
        self._interrupted = True

    def raise_if_interrupted(self) -> None:
        """Raise KeyboardInterrupt after SIGINT."""
        if self._interrupted:
            raise KeyboardInterrupt

    def on_start(self, _: event.Event) -> None:
        """Raise KeyboardInterrupt after SIGINT; otherwise show the bar, once."""
        self.raise_if_interrupted()
        if not self._is_shown:
            self._is_shown = True
            self._show()
        self.on_kernel()

    def on_end(self, _: event.Event) -> None:
        """Do nothing: the end of a compilation is not needed."""


class _CompileBar:
    """Bar with the fraction of all kernels that are in the cache."""

    def __init__(self, bar: Progress) -> None:
        self._bar, self._task = bar, bar.add_task(COMPILE_LABEL, total=count_kernels())

    def update(self) -> None:
        """Draw the number of kernels in the cache. Other processes may compile some of them."""
        self._bar.update(self._task, completed=count_cached_kernels())


def _to_stderr(text: str) -> None:
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()
