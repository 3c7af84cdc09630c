"""Table on stdout."""

from collections.abc import Iterable, Sequence

from rich import box
from rich.console import Console
from rich.table import Table

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
