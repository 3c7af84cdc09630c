"""Output of commands: a table, a number with its noun, the status line of a command that waits, and a silenced log."""

import logging
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext

import structlog
from rich import box
from rich.console import Console
from rich.table import Table


@contextmanager
def silenced_log() -> Iterator[None]:
    """Silence the log within the context."""
    previous_config = structlog.get_config()
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))
    try:
        yield
    finally:
        structlog.configure(**previous_config)


def show_status(text: str) -> AbstractContextManager[object]:
    """Show a text with a spinner within the context, if stderr is a terminal."""
    console = Console(stderr=True)
    return console.status(text) if console.is_terminal else nullcontext()


def count_text(count: int, noun: str, plural: str | None = None) -> str:
    """Return a number with a noun in singular or plural; ``plural`` is the noun with an s by default."""
    return f"{count} {noun if count == 1 else plural or f'{noun}s'}"


MAX_TABLE_WIDTH = 10_000
"""Maximum width of a printed table [characters], above that of any result."""


def print_table(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Print a table without truncating its columns to the terminal's width.

    Args:
        columns: Headings.
        rows: Values; floats are printed with four digits, None as an empty cell.
    """
    table = Table(*columns, box=box.SIMPLE)
    for row in rows:
        table.add_row(
            *("" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value) for value in row)
        )
    console = Console(highlight=False, markup=False)
    console.width = max(
        console.width, console.measure(table, options=console.options.update(max_width=MAX_TABLE_WIDTH)).maximum
    )
    console.print(table)
