"""Table of targets and measured values."""

from collections.abc import Iterable
from dataclasses import dataclass

from rich.console import Console
from rich.live import Live
from rich.table import Table


@dataclass(frozen=True)
class Row:
    """Row of the table."""

    what: str
    """Measured quantity."""
    target: str
    measured: str
    met: bool | None
    """True if the target is met; None: there is no target."""


def show(rows: Iterable[Row], title: str = "bms_estimator benchmarks") -> bool:
    """Print the rows as they arrive; return True if all targets were met."""
    table = Table(title=title)
    for column in ("what", "target", "measured", "met"):
        table.add_column(column)
    all_met = True
    with Live(table, console=Console(), auto_refresh=False) as live:
        for row in rows:
            table.add_row(row.what, row.target, row.measured, {None: "", True: "yes", False: "[red]no"}[row.met])
            live.refresh()
            all_met &= row.met is not False
    return all_met
