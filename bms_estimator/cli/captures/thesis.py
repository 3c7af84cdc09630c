"""``bms-estimator thesis``: report that recomputes the thesis."""

import textwrap
import time
from collections import Counter
from pathlib import Path
from typing import Annotated

import typer
from rich import box
from rich.console import Console
from rich.table import Table

from bms_estimator.cli.options.capture_input import load_captures
from bms_estimator.cli.options.capture_options import (
    CAPTURE_FORMATS,
    CELL_HELP,
    CapacityAh,
    MappedColumns,
    SignOfCurrent,
    complete_battery,
    name_of,
    reject_duplicates,
)
from bms_estimator.cli.options.pack_options import LABORATORY_RESOLUTION_V, decimal
from bms_estimator.cli.options.progress_bar import progress_bar
from bms_estimator.model.arrays import CurrentSign
from bms_estimator.model.cell import load_cell
from bms_estimator.model.errors import UserError
from bms_estimator.reports.thesis import report_items
from bms_estimator.reports.thesis.experiment import RecordedCaptures
from bms_estimator.reports.thesis.report import LONG_CELL, Report, build, write
from bms_estimator.sources.captures.tables.layout import ColumnMap

MIN_TABLE_WIDTH = 160
"""Minimum width of a printed table [characters]."""
COLUMN_TITLE_WIDTH = 12
"""Width at which the titles of columns are wrapped [characters]."""


def thesis(
    captures: Annotated[
        list[Path] | None,
        typer.Argument(help=f"captures for chapter 5, each {CAPTURE_FORMATS}; default: a simulated 6S pack"),
    ] = None,
    cell: Annotated[
        str | None,
        typer.Option(help=f"cell of the captures: {CELL_HELP}", autocompletion=complete_battery, show_default=False),
    ] = None,
    capacity_ah: CapacityAh = None,
    resolution_v: Annotated[
        float, typer.Option(parser=decimal(1e-9), help="voltage resolution (LSB) of the captures [V]")
    ] = LABORATORY_RESOLUTION_V,
    current_sign: SignOfCurrent = None,
    column_map: MappedColumns = None,
    out: Annotated[Path, typer.Option(help="folder for the report")] = Path("thesis-report"),
    table: Annotated[
        str | None, typer.Option(help="recompute only this table: 1 to 13, or Errata", show_default=False)
    ] = None,
    figure: Annotated[str | None, typer.Option(help="recompute only this figure: 1 to 50", show_default=False)] = None,
) -> None:
    """Recompute the tables and figures of the thesis, and write a report that compares them with the printed ones.

    The thesis is "Adaptive Estimation of Li-ion Battery Model Parameters".
    The report is one HTML page. Chapters 2 to 4 are simulated.
    Chapter 5 is computed from the captures, all of one type of cell.
    At least one capture must be a voltage relaxation test, and at least one a constant load or a load with steps.
    """
    recorded = _load_recorded(captures, cell, capacity_ah, resolution_v, current_sign, column_map) if captures else None
    started_s = time.perf_counter()
    with progress_bar("recomputing the thesis") as bar:
        report = build(
            recorded,
            table=table,
            figure=figure,
            progress=lambda title, done, total: bar.update(done / total, f"recomputing {title}"),
        )
        try:
            path = write(report, out)
        except OSError as error:
            raise UserError(f"--out {out}: cannot be written: {error.strerror}") from None
    console = Console()
    if table or figure:
        _print_items(console, report)
    counts = Counter(item.verdict.value for item in report.items)
    typer.echo("; ".join(f"{count} {verdict}" for verdict, count in counts.items()))
    typer.echo(f"{path}: written in {time.perf_counter() - started_s:.1f} s")


def _load_recorded(
    captures: list[Path],
    cell: str | None,
    capacity_ah: float | None,
    resolution_v: float,
    current_sign: CurrentSign | None,
    column_map: ColumnMap | None,
) -> RecordedCaptures:
    if cell is None:
        raise UserError("captures require --cell NAME|CELL.toml, which gives capacity, limits and bounds of the cell")
    reject_duplicates(captures)
    loaded = load_captures(captures, current_sign=current_sign, column_map=column_map)
    named_rows = tuple((name_of(path), capture.rows) for path, capture in zip(captures, loaded, strict=True))
    return RecordedCaptures(load_cell(cell, capacity_ah), named_rows, resolution_v)


def _print_items(console: Console, report: Report) -> None:
    for item in report.items:
        if isinstance(item, report_items.Table):
            printed = Table(title=f"{report_items.name(item)}  {item.title}", title_justify="left", box=box.SIMPLE_HEAD)
            for column, cells in zip(item.columns, zip(*item.rows, strict=True), strict=True):
                is_text = max(map(len, cells)) > LONG_CELL
                title = textwrap.fill(column, COLUMN_TITLE_WIDTH)
                printed.add_column(title, justify="left" if is_text else "right", no_wrap=not is_text)
            for row in item.rows:
                printed.add_row(*row)
            Console(width=max(console.width, MIN_TABLE_WIDTH)).print(printed)
        else:
            console.print(f"Figure {item.key}  {item.title}", highlight=False)
        console.print(f"{report_items.label(item)}: {item.reason}", highlight=False)
