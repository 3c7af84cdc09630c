"""Bar with label, percentage and time left, in the same form for all commands."""

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

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
