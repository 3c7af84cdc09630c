"""``bms-estimator edge``: sender of a pack's raw samples to a fleet's server.

The command imports kernels only if decoding the board's frames needs them.
"""

import asyncio
from pathlib import Path
from typing import Annotated

import typer

from bms_estimator.cli.options.pack_options import with_sensor
from bms_estimator.cli.options.port_options import OtherPort
from bms_estimator.process.log_setup import configure_logs, flush_logs
from bms_estimator.process.signals import startup_signals
from bms_estimator.process.state_folder import state_folder
from bms_estimator.service.edge_service import serve_edge
from bms_estimator.settings.pack import load_settings


def edge(
    pack: Annotated[Path, typer.Argument(help="settings file of the pack, with a section \\[edge]")] = Path(
        "pack.toml"
    ),
    port: OtherPort = None,
) -> None:
    """Send a pack's raw samples to a fleet server until SIGINT or SIGTERM.

    The fleet's workers estimate SOC and parameters from the samples.
    Samples are stored on disk until the server confirms them (docs/fleet/edge.md).
    """
    settings = with_sensor(load_settings(pack), port=port)
    configure_logs()
    with startup_signals(), flush_logs():
        asyncio.run(serve_edge(settings, state_folder(settings)))
