"""Progress bar on stderr while kernels compile.

Only a first start compiles kernels, for about a minute on two idle cores. Later starts load them from the cache.
"""

from collections.abc import Callable
from functools import partial

import typer
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
    columns = (
        TextColumn("{task.description}"),
        BarColumn(BAR_WIDTH),
        TaskProgressColumn(),
        TimeRemainingColumn(),
    )
    return Progress(*columns, console=console, disable=not console.is_terminal, transient=True)


def compile_ahead(report: Callable[[str], object] | None = None) -> None:
    """Compile all kernels that are not in the cache. Announce it, and show a bar with the number of kernels and the time left.

    Args:
        report: Called with ``COMPILE_TEXT``; default: write to stderr.

    Raises:
        TemporaryError: The memory is not sufficient.
    """
    if is_compiled():
        return
    console = Console(stderr=True)
    (report or partial(typer.echo, err=True))(COMPILE_TEXT)
    with new_bar(console) as bar:
        task = bar.add_task(COMPILE_LABEL, total=None)

        def update(progress: kernel_compilation.Progress) -> None:
            label = f"{COMPILE_LABEL}: {progress.kernels} of {progress.all_kernels}"
            bar.update(task, description=label, total=progress.all_cpu_s, completed=progress.cpu_s)

        compile_kernels(update)
