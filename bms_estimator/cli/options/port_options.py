"""Option for a serial port, with completion of the names of connected ports."""

from typing import Annotated

import typer

from bms_estimator.sources.serial.port_list import named_ports


def complete_port(incomplete: str) -> list[str]:
    """Return the connected serial ports whose names begin with ``incomplete``."""
    return [name for name in named_ports() if name.startswith(incomplete)]


PortOverride = Annotated[
    str | None,
    typer.Option(help="serial port that replaces sensor.port of the settings", autocompletion=complete_port),
]
"""Option that replaces the serial port of the settings."""
