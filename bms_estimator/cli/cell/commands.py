"""``bms-estimator cell``: commands that write a cell, from a learned state or in another format."""

import typer

from bms_estimator.cli.cell.convert import convert
from bms_estimator.cli.cell.export import export

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    help="Write a cell file from a pack's learned state, or convert a cell file for another program.",
)
app.command()(export)
app.command()(convert)
