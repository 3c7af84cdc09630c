"""``bms-estimator run``: the service of one pack."""

import asyncio
import contextlib
import sys
from collections import deque
from pathlib import Path
from typing import Annotated

import typer

from bms_estimator.cli.pack import load_pack, with_broker, with_sensor
from bms_estimator.service.logs import configure_logs
from bms_estimator.service.serve import serve
from bms_estimator.sinks.console import ConsoleSink
from bms_estimator.sources.raw_capture import header_of
from bms_estimator.sources.recording import Recording

LOG_LINES = 5
"""So many of the log's last lines stay in sight below the live view."""


def run(
    pack: Annotated[Path, typer.Option(help="settings of the pack")] = Path("pack.toml"),
    port: Annotated[str | None, typer.Option(help="serial port in place of sensor.port")] = None,
    mqtt: Annotated[str | None, typer.Option(help="broker in place of mqtt.url, mqtt://host:port")] = None,
    record: Annotated[
        Path | None, typer.Option(help="also record the board's raw bytes in this new file", show_default=False)
    ] = None,
    view: Annotated[
        bool | None, typer.Option("--view/--no-view", help="live view on stdout; without either: on a terminal")
    ] = None,
) -> None:
    """Estimate live from a board and publish, until SIGINT or SIGTERM."""
    settings, cell = load_pack(pack)
    settings = with_sensor(settings, port=port)
    settings = with_broker(settings, mqtt) if mqtt else settings
    shown = sys.stdout.isatty() if view is None else view
    log: deque[str] = deque(maxlen=LOG_LINES)
    configure_logs(log if shown and sys.stdout.isatty() else None)
    recorder = Recording(record, header_of(settings.sensor)) if record else contextlib.nullcontext()
    sinks = [ConsoleSink(log=log)] if shown else []
    with recorder as tap:
        asyncio.run(serve(settings, cell, sinks=sinks, tap=tap))
