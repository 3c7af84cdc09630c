"""``bms-estimator fleet ingest``: intake of batches from a telemetry platform."""

import asyncio
import os
from pathlib import Path
from typing import Annotated

import typer

from bms_estimator.cli.fleet.server_options import DEFAULT_SERVER, Ca, Creds, Server
from bms_estimator.model.arrays import CurrentSign
from bms_estimator.sources.captures.tables.layout import ColumnMap
from bms_estimator.sources.captures.tables.layout_finder import parse_column_map

GB = 10**9
"""Gigabyte [bytes]."""


def ingest(
    server: Server = DEFAULT_SERVER,
    creds: Creds = None,
    ca: Ca = None,
    folder: Annotated[
        Path | None,
        typer.Option(
            help="folder of the blocks that no worker has confirmed; default: the state folder of systemd, or ~/.local/state/bms-estimator-ingest",
            show_default=False,
        ),
    ] = None,
    parquet: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="PATH",
            help="Parquet file, or folder of such files, with the history of packs; the command sends it and ends; may be given several times",
            show_default=False,
        ),
    ] = None,
    columns: Annotated[
        ColumnMap | None,
        typer.Option(
            "--map",
            parser=parse_column_map,
            metavar="time=COLUMN,...",
            help="columns with unknown names, for time, current, voltage and, optionally, temperature",
            show_default=False,
        ),
    ] = None,
    current_sign: Annotated[
        CurrentSign | None,
        typer.Option(
            metavar="SIGN",
            help="direction of positive current: discharge_positive or charge_positive; default: that of a recognized format, "
            "otherwise discharge_positive",
        ),
    ] = None,
    block_s: Annotated[
        float,
        typer.Option(min=1.0, max=3600.0, help="duration of a block, which is sent to the workers as one message"),
    ] = 60.0,
    buffer_gb: Annotated[
        float, typer.Option(min=0.001, help="maximum size of the batches that wait on the server [GB]")
    ] = 1.0,
) -> None:
    """Receive batches of samples from a telemetry platform, in place of the edges of its packs, until SIGINT, SIGTERM or SIGHUP.

    The platform publishes a batch, JSON or Arrow, on the NATS subject telemetry.PACK or the MQTT topic telemetry/PACK.
    """
    from bms_estimator.fleet.ingest.ingest import ingest  # noqa: PLC0415 - its packages are optional
    from bms_estimator.fleet.ingest.startup import Options  # noqa: PLC0415
    from bms_estimator.process.runtime import (  # noqa: PLC0415
        configure_logs,
        flush_logs,
        stop_on_signal,
    )

    options = Options(
        server, folder or _default_folder(), block_s, round(buffer_gb * GB), creds, ca, columns, current_sign
    )

    async def run() -> None:
        if parquet:
            from bms_estimator.fleet.ingest.backfill import backfill  # noqa: PLC0415 - only the backfill needs Arrow

            typer.echo(await backfill(options, parquet, stop_on_signal()))
        else:
            await ingest(options, stop_on_signal())

    configure_logs()
    with flush_logs():
        asyncio.run(run())


def _default_folder() -> Path:
    systemd_folder = os.environ.get("STATE_DIRECTORY", "").split(":")[0]
    user_folder = Path(os.environ.get("XDG_STATE_HOME") or "~/.local/state") / "bms-estimator-ingest"
    return Path(systemd_folder or user_folder).expanduser()
