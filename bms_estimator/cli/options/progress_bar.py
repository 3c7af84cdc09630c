"""Progress bar with the time left, on stderr if it is a terminal."""

from collections.abc import Iterator
from contextlib import contextmanager

from numba.core import event
from rich.console import Console
from rich.progress import Progress

from bms_estimator.cli.options.compile_progress import COMPILE_TEXT, CompileListener, new_bar

MIN_CHANGE = 0.001
"""Minimum change of the fraction that is drawn. A calculation may report its progress more often."""


class ProgressBar:
    """Bar that is drawn while the context of ``progress_bar`` lasts."""

    def __init__(self, label: str, bar: Progress) -> None:
        self._bar, self._task = bar, bar.add_task(label, total=1.0)
        self._drawn, self._label = 0.0, label

    def update(self, fraction: float, label: str | None = None) -> None:
        """Draw the finished fraction, 0..1, and another label if one is given."""
        label = label or self._label
        if label != self._label or abs(fraction - self._drawn) >= MIN_CHANGE:
            self._drawn, self._label = fraction, label
            self._bar.update(self._task, completed=fraction, description=label)

    def show_compilation(self) -> None:
        """Print above the bar that kernels compile. The time left does not include the compilation."""
        self._bar.console.print(COMPILE_TEXT)


@contextmanager
def progress_bar(label: str) -> Iterator[ProgressBar]:
    """Show a bar for the duration of the context. Nothing is written if stderr is not a terminal.

    Args:
        label: Name of the work, such as ``identifying``.
    """
    console = Console(stderr=True)
    with new_bar(console) as progress:
        bar = ProgressBar(label, progress)
        if not console.is_terminal:
            yield bar
            return
        with event.install_listener("numba:compile", CompileListener(bar.show_compilation)):
            yield bar
