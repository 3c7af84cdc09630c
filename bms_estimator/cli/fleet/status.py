"""``bms-estimator fleet status``: table of the workers, their versions and the partitions that they refuse."""

import asyncio
from typing import TYPE_CHECKING, Annotated

import typer

from bms_estimator.cli.fleet.server_options import DEFAULT_SERVER, Ca, Creds, Server, ServerAddress
from bms_estimator.cli.options.table import print_table

if TYPE_CHECKING:
    from bms_estimator.fleet.heartbeat import Heartbeat

COLUMNS = ("worker", "version", "partitions", "packs", "lag s", "checkpoint formats", "block version")


def status(
    server: Server = DEFAULT_SERVER,
    creds: Creds = None,
    ca: Ca = None,
    blocks: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="end with exit code 1 unless every worker reads this version of blocks; check it before an upgrade of edges",
            show_default=False,
        ),
    ] = None,
) -> None:
    """List the workers with their versions, and the partitions that they refuse."""
    heartbeats = asyncio.run(_receive_heartbeats((server, creds, ca)))
    print_table(COLUMNS, [_row(each) for each in heartbeats])
    for heartbeat in heartbeats:
        for line in refusals(heartbeat):
            typer.echo(line)
    if not heartbeats:
        typer.echo("no worker")
    if blocks is not None:
        _check_block_version(heartbeats, blocks)


def refusals(heartbeat: "Heartbeat") -> list[str]:
    """Return a line for each partition that a worker refuses."""
    return [
        f"partition {each.partition}: {heartbeat.id} refuses it, because its checkpoint is of format "
        f"{each.format or 'unknown'}: start a worker of the version that wrote it"
        for each in heartbeat.refused
    ]


def _row(heartbeat: "Heartbeat") -> tuple[object, ...]:
    oldest, newest = heartbeat.oldest_checkpoint_format, heartbeat.checkpoint_format
    return (
        heartbeat.id,
        heartbeat.version,
        len(heartbeat.partitions),
        heartbeat.packs,
        heartbeat.lag_s,
        newest if oldest == newest else f"{oldest}, {newest}",
        heartbeat.block_version,
    )


def _check_block_version(heartbeats: "list[Heartbeat]", version: int) -> None:
    """Print whether all workers read a version of blocks; otherwise, or without a worker, end with exit code 1."""
    older = [each.id for each in heartbeats if each.block_version < version]
    if older:
        typer.echo(f"blocks of version {version} are unreadable for {', '.join(older)}: upgrade these workers first")
    if older or not heartbeats:
        raise typer.Exit(1)
    typer.echo(f"all workers read blocks of version {version}: edges that send them can start")


async def _receive_heartbeats(address: ServerAddress) -> "list[Heartbeat]":
    """Return the newest heartbeat of each worker, sorted by name, after two intervals."""
    from bms_estimator.edge import subjects  # noqa: PLC0415 - NATS is optional
    from bms_estimator.fleet.heartbeat import HEARTBEAT_S, Heartbeat  # noqa: PLC0415
    from bms_estimator.fleet.nats.one_shot_connection import connected  # noqa: PLC0415

    newest = dict[str, Heartbeat]()
    async with connected(*address) as nc:
        subscription = await nc.subscribe(subjects.worker())
        await asyncio.sleep(2.0 * HEARTBEAT_S)
        while subscription.pending_msgs:
            heartbeat = Heartbeat.model_validate_json((await subscription.next_msg()).data)
            newest[heartbeat.id] = heartbeat
    return [newest[name] for name in sorted(newest) if not newest[name].leaving]
