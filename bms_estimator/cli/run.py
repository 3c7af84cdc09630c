"""``bms-estimator run``: the service of one pack, or of several."""

import asyncio
import contextlib
import sys
from collections import deque
from pathlib import Path
from typing import Annotated

import structlog
import typer

from bms_estimator.cli.compiling import compiling_shown
from bms_estimator.cli.pack import load_pack, with_broker, with_sensor
from bms_estimator.model.errors import UserError
from bms_estimator.model.fuel_cell import PackModel
from bms_estimator.model.settings import Settings
from bms_estimator.service.logs import configure_logs, drained
from bms_estimator.service.serve import serve, state_folder
from bms_estimator.service.several import serve_several
from bms_estimator.service.warm_up import load_kernels
from bms_estimator.sinks.console import ConsoleSink
from bms_estimator.sources.raw_capture import header_of
from bms_estimator.sources.recording import Recording

LOG_LINES = 5
"""So many of the log's last lines stay in sight below the live view."""


def run(
    packs: Annotated[
        list[Path] | None, typer.Argument(help="settings of the pack, or of each", show_default="pack.toml")
    ] = None,
    port: Annotated[str | None, typer.Option(help="serial port in place of sensor.port")] = None,
    mqtt: Annotated[str | None, typer.Option(help="broker in place of mqtt.url, mqtt://host:port")] = None,
    record: Annotated[
        Path | None, typer.Option(help="also record the board's raw bytes in this new file", show_default=False)
    ] = None,
    view: Annotated[
        bool | None, typer.Option("--view/--no-view", help="live view on stdout; without either: on a terminal")
    ] = None,
) -> None:
    """Estimate live from a board and publish, until SIGINT or SIGTERM.

    Several packs are served in one process, each with its own board and connection to the broker.
    """
    loaded = [load_pack(pack) for pack in packs or [Path("pack.toml")]]
    if mqtt:
        loaded = [(with_broker(settings, mqtt), cell) for settings, cell in loaded]
    if len(loaded) == 1:
        _run_one(*loaded[0], port, record, view=sys.stdout.isatty() if view is None else view)
        return
    if port or record or view:
        raise UserError("--port, --record and --view are for one pack")
    configure_logs()
    _load_kernels()
    with drained():
        asyncio.run(serve_several(loaded))


def _run_one(settings: Settings, cell: PackModel, port: str | None, record: Path | None, *, view: bool) -> None:
    settings = with_sensor(settings, port=port)
    log: deque[str] = deque(maxlen=LOG_LINES)
    configure_logs(log if view and sys.stdout.isatty() else None)
    recorder = Recording(record, header_of(settings.sensor)) if record else contextlib.nullcontext()
    sinks = [ConsoleSink(log=log)] if view else []
    with drained(), recorder as tap:
        _load_kernels()
        asyncio.run(serve(settings, cell, sinks=sinks, tap=tap, folder=state_folder(settings)))


def _load_kernels() -> None:
    with compiling_shown(structlog.get_logger(__name__).info):
        load_kernels()
