"""``bms-estimator fleet backup`` and ``fleet restore``: copy of a tenant's streams, and a new server from it."""

from pathlib import Path
from typing import Annotated

import typer

from bms_estimator.cli.fleet.server_options import DEFAULT_SERVER, Ca, Creds, Server, on_server


def backup(
    folder: Annotated[
        Path, typer.Argument(help="folder of the backup; must be empty or not exist", show_default=False)
    ],
    include: Annotated[
        list[Path] | None,
        typer.Option(help="file or folder to copy into the backup, such as fleet.toml and keys; repeat for several"),
    ] = None,
    server: Server = DEFAULT_SERVER,
    creds: Creds = None,
    ca: Ca = None,
) -> None:
    """Write a backup of the streams of a tenant while server, workers and edges run. It needs admin.creds.

    The backup contains samples, hourly summaries, dead letters, the table of packs and the checkpoints. It does not
    contain batches that wait for `fleet ingest`.
    """
    from bms_estimator.fleet.server.backup import back_up  # noqa: PLC0415 - NATS is optional

    on_server((server, creds, ca), lambda nc: back_up(nc, folder, include or [], typer.echo))


def restore(
    folder: Annotated[Path, typer.Argument(help="folder of the backup", show_default=False)],
    server: Server = DEFAULT_SERVER,
    creds: Creds = None,
    ca: Ca = None,
) -> None:
    """Restore the streams of a tenant from a backup, before workers and edges connect. It needs admin.creds.

    The server must run and must not have any data of the tenant.
    """
    from bms_estimator.fleet.server.backup import restore as restore_streams  # noqa: PLC0415 - NATS is optional

    on_server((server, creds, ca), lambda nc: restore_streams(nc, folder, typer.echo))
