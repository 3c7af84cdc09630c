"""``bms-estimator ports``: which serial ports there are, and what is on them."""

from typing import Annotated

import typer
from rich import box
from rich.console import Console
from rich.table import Table
from serial.tools import list_ports

from bms_estimator.cli.decimal_option import whole
from bms_estimator.sources.ports import holder, stable_names
from bms_estimator.sources.probe import probe as ask
from bms_estimator.sources.protocol import BAUD


def ports(
    paths: Annotated[list[str] | None, typer.Argument(help="these only; else all that are found")] = None,
    probe: Annotated[
        bool, typer.Option("--probe", help="ask each for a board; opening a port may reset its board")
    ] = False,
    baud: Annotated[int, typer.Option(parser=whole(1200), help="to ask at")] = BAUD,
) -> None:
    """List serial ports under their stable names, and ask them for a board.

    ``stable name`` is what belongs in ``sensor.port``: it stays when boards are plugged in another order.
    """
    found = {port.device: port.description for port in list_ports.comports()}
    shown = {path: found.get(path, "") for path in paths} if paths else found
    if not shown:
        typer.echo("no serial port is there; is the board plugged in?")
        return
    names = {str(name.resolve()): str(name) for name in stable_names()}
    table = Table(box=box.SIMPLE_HEAD)
    for title in ("port", "what it says of itself", "held by", *(["board"] if probe else [])):
        table.add_column(title, overflow="fold")
    for device, description in sorted(shown.items()):
        name = names.get(device, device)
        table.add_row(name, description, holder(device) or "", *([ask(device, baud)] if probe else []))
    Console().print(table)
