"""``bms-estimator ports``: serial ports, and the devices on them."""

from contextlib import AbstractContextManager, nullcontext
from typing import Annotated

import typer
from rich import box
from rich.console import Console
from rich.table import Table
from serial.tools import list_ports

from bms_estimator.cli.options.number_options import whole
from bms_estimator.sources.serial.device_detection import probe as ask
from bms_estimator.sources.serial.port_list import holder, stable_names


def ports(
    paths: Annotated[list[str] | None, typer.Argument(help="these only; else all that are found")] = None,
    probe: Annotated[
        bool, typer.Option("--probe", help="identify the device on each port; opening a port may reset its board")
    ] = False,
    baud: Annotated[
        int | None,
        typer.Option(
            parser=whole(1200), help="baud rate of the probe; default: that of each protocol", show_default=False
        ),
    ] = None,
) -> None:
    """List serial ports by their stable names, and identify boards, BMS and meters on them.

    A stable name does not change when devices are plugged in another order. Use it as ``sensor.port``.
    """
    found = {port.device: port.description for port in list_ports.comports()}
    shown = {path: found.get(path, "") for path in paths} if paths else found
    if not shown:
        typer.echo("no serial port is there; is the board plugged in?")
        return
    names = {str(name.resolve()): str(name) for name in stable_names()}
    table = Table(box=box.SIMPLE_HEAD)
    for title in ("port", "what it says of itself", "held by", *(["who is there"] if probe else [])):
        table.add_column(title, overflow="fold")
    for device, description in sorted(shown.items()):
        name = names.get(device, device)
        held = holder(device) or ""
        with asking(device) if probe else nullcontext():
            table.add_row(name, description, held, *([str(ask(device, baud))] if probe else []))
    Console().print(table)


def asking(port: str) -> AbstractContextManager[object]:
    """Show on a terminal that the probe takes a while."""
    console = Console(stderr=True)
    return console.status(f"asking on {port} who is there: up to 20 s") if console.is_terminal else nullcontext()
