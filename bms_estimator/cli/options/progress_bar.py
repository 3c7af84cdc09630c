"""Progress bar with the time left, on stderr if it is a terminal."""

from collections.abc import Iterator
from contextlib import contextmanager

from numba.core import event
from rich.console import Console
from rich.progress import Progress

from bms_estimator.cli.options.compile_progress import COMPILE_TEXT, new_bar

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
        if not console.is_terminal:
            yield bar
            return
        with event.install_listener("numba:compile", bar):
            yield bar
