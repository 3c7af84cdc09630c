"""``bms-estimator ports``: list of serial ports, and the devices on them."""

from contextlib import nullcontext
from typing import Annotated

import typer
from rich import box
from rich.console import Console
from rich.table import Table
from serial.tools import list_ports

from bms_estimator.cli.options.pack_options import complete_port, whole
from bms_estimator.cli.options.table import show_status
from bms_estimator.sources.serial.device_detection import probe as probe_port
from bms_estimator.sources.serial.port_list import holder, stable_names


def ports(
    paths: Annotated[
        list[str] | None, typer.Argument(help="paths of serial ports; default: all ports", autocompletion=complete_port)
    ] = None,
    probe: Annotated[
        bool, typer.Option("--probe", help="open each port and identify its device; this may reset a board")
    ] = False,
    baud: Annotated[
        int | None,
        typer.Option(
            parser=whole(1200),
            help="baud rate at which devices are probed; default: the baud rate of each protocol",
            show_default=False,
        ),
    ] = None,
) -> None:
    """List serial ports by their stable names; with --probe, identify the boards, BMS and meters on them.

    A stable name does not depend on the order in which devices are plugged in. Use such a name as `sensor.port`.
    """
    existing = {port.device: port.description for port in list_ports.comports()}
    listed = {path: existing.get(path, "") for path in paths} if paths else existing
    if not listed:
        typer.echo("there is no serial port; is the board plugged in?")
        return
    stable_by_device = {str(name.resolve()): str(name) for name in stable_names()}
    table = Table(box=box.SIMPLE_HEAD)
    for title in ("port", "description", "opened by", *(["device"] if probe else [])):
        table.add_column(title, overflow="fold")
    for device, description in sorted(listed.items()):
        name = stable_by_device.get(device, device)
        opened_by = holder(device) or ""
        with show_status(f"probing {device}: up to 20 s") if probe else nullcontext():
            table.add_row(name, description, opened_by, *([str(probe_port(device, baud))] if probe else []))
    Console().print(table)
