"""``bms-estimator run``: the service of one pack."""

import asyncio
import contextlib
import sys
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import structlog
import typer

from bms_estimator.cli.compiling import compiling_shown
from bms_estimator.cli.pack import load_pack, with_broker, with_sensor
from bms_estimator.cli.record import SYNC_S
from bms_estimator.model.cell import CellModel
from bms_estimator.model.settings import Settings
from bms_estimator.service.interrupt import until_first_ends
from bms_estimator.service.logs import configure_logs
from bms_estimator.service.serve import serve
from bms_estimator.service.warm_up import load_kernels
from bms_estimator.sinks import Sink
from bms_estimator.sinks.console import ConsoleSink
from bms_estimator.sources.raw_capture import CaptureWriter, header_of

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
    recorder = CaptureWriter(record, header_of(settings.sensor)) if record else contextlib.nullcontext()
    sinks = [ConsoleSink(log=log)] if shown else []
    with recorder as writer:
        with compiling_shown(structlog.get_logger(__name__).info):
            load_kernels()
        if writer is None:
            asyncio.run(serve(settings, cell, sinks=sinks))
        else:
            asyncio.run(serve_and_record(settings, cell, sinks, writer))


async def serve_and_record(settings: Settings, cell: CellModel, sinks: Sequence[Sink], writer: CaptureWriter) -> None:
    """Serve until a signal; all but the last seconds of the recording outlive a loss of power.

    Args:
        settings: The pack's settings.
        cell: The pack as one object.
        sinks: Further sinks.
        writer: Gets the board's bytes.
    """
    await until_first_ends(serve(settings, cell, sinks=sinks, tap=writer), _sync_often(writer))


async def _sync_often(writer: CaptureWriter) -> None:
    """Have the disk take what there is; one that fails does not end the estimate."""
    try:
        while True:
            await asyncio.sleep(SYNC_S)
            await asyncio.to_thread(writer.sync)
    except OSError as error:
        structlog.get_logger(__name__).warning("recording may not reach the disk", reason=str(error))
    await asyncio.Event().wait()
