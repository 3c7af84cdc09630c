"""Progress bars on stderr if it is a terminal: with the time left, and while kernels compile.

Only a first start compiles kernels, for about a minute on two idle cores. Later starts load them from the cache.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from functools import partial

import typer
from numba.core import event
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from bms_estimator.service import kernel_compilation
from bms_estimator.service.kernel_compilation import compile_kernels, is_compiled

BAR_WIDTH = 24
"""Width of the bar [characters]. With a long label, the line fits into 80 columns."""
COMPILE_TEXT = (
    "compiling the kernels; this takes a minute, or several on a small machine, and later starts use the cache"
)
"""Line before the compilation. The bar does not appear on each terminal."""
COMPILE_LABEL = "compiling kernels"
"""Label of the bar."""


def new_bar(console: Console) -> Progress:
    """Return a bar that disappears at its end. It writes nothing if the console is not a terminal."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(BAR_WIDTH),
        TaskProgressColumn(),
        TimeRemainingColumn(),
        console=console,
        disable=not console.is_terminal,
        transient=True,
    )


def compile_ahead(
    report: Callable[[str], object] | None = None,
    compile_all: Callable[[kernel_compilation.Report], None] = compile_kernels,
) -> None:
    """Compile all kernels that are not in the cache. Announce it, and show a bar with the number of kernels and the time left.

    Args:
        report: Called with ``COMPILE_TEXT``; default: write to stderr.
        compile_all: Compiles the kernels, or waits until they are compiled; called with a function that receives the progress.

    Raises:
        TemporaryError: The memory is not sufficient.
    """
    if is_compiled():
        return
    (report or partial(typer.echo, err=True))(COMPILE_TEXT)
    with new_bar(Console(stderr=True)) as bar:
        task = bar.add_task(COMPILE_LABEL, total=None)

        def update(progress: kernel_compilation.Progress) -> None:
            bar.update(
                task,
                description=f"{COMPILE_LABEL}: {progress.kernels} of {progress.all_kernels}",
                total=progress.all_cpu_s,
                completed=progress.cpu_s,
            )

        compile_all(update)


MIN_CHANGE = 0.001
"""Minimum change of the fraction that is drawn. A calculation may report its progress more often."""


class ProgressBar(event.Listener):
    """Bar that is drawn while the context of ``progress_bar`` lasts."""

    def __init__(self, label: str, bar: Progress) -> None:
        self._bar, self._task = bar, bar.add_task(label, total=1.0)
        self._drawn, self._label, self._has_compiled = 0.0, label, False

    def update(self, fraction: float, label: str | None = None) -> None:
        """Draw the finished fraction, 0..1, and another label if one is given."""
        label = label or self._label
        if label != self._label or abs(fraction - self._drawn) >= MIN_CHANGE:
            self._drawn, self._label = fraction, label
            self._bar.update(self._task, completed=fraction, description=label)

    def on_start(self, _: event.Event) -> None:
        """Print above the bar, once, that kernels compile. The time left does not include the compilation."""
        if not self._has_compiled:
            self._has_compiled = True
            self._bar.console.print(COMPILE_TEXT)

    def on_end(self, _: event.Event) -> None:
        """Do nothing: the end of a compilation is not needed."""


@contextmanager
def progress_bar(label: str) -> Iterator[ProgressBar]:
    """Show a bar for the duration of the context. Nothing is written if stderr is not a terminal.

    Args:
        label: Name of the work, such as ``identifying``.
    """
    console = Console(stderr=True)
    with new_bar(console) as progress:
        bar = ProgressBar(label, progress)
        with event.install_listener("numba:compile", bar) if console.is_terminal else nullcontext():
            yield bar
