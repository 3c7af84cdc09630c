"""``bms-estimator fleet status``: table of the workers, and what needs attention."""

import asyncio
from datetime import timedelta
from typing import TYPE_CHECKING, Annotated

import typer

from bms_estimator.cli.fleet.server_options import DEFAULT_SERVER, Ca, Creds, Server, on_server
from bms_estimator.cli.options.table import count_text, print_table
from bms_estimator.model.errors import UserError

if TYPE_CHECKING:
    from nats.aio.client import Client

    from bms_estimator.fleet.heartbeat import Heartbeat
    from bms_estimator.fleet.nats.dead_packs import DeadPacks

STREAMS_TIMEOUT_S = 10.0
"""Timeout of the requests to the streams [s]."""
MIN_CLOCKS = 2
"""Number of packs of a worker above which errors of most clocks prove that the server's clock is wrong."""
COLUMNS = ("worker", "version", "partitions", "packs", "lag s", "checkpoint formats", "block version")


def status(
    server: Server = DEFAULT_SERVER,
    creds: Creds = None,
    ca: Ca = None,
    blocks: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="version of blocks; end with exit code 1 if a worker does not read it. Check this before you upgrade edges",
            show_default=False,
        ),
    ] = None,
) -> None:
    """List the workers with their versions, and what needs attention.

    The output lists errors of workers, refused partitions, unknown packs that send blocks, packs with dead letters, and packs whose edge's
    clock is wrong. A warning follows if more than half of the stream is filled by blocks that no checkpoint includes.
    """
    heartbeats = on_server((server, creds, ca), _receive_heartbeats)
    print_table(COLUMNS, [_row(each) for each in heartbeats])
    for heartbeat in heartbeats:
        trouble = [f"{heartbeat.id}: {heartbeat.trouble}"] if heartbeat.trouble else []
        for line in (*trouble, *_refusals(heartbeat), *_unknown_packs(heartbeat), *_clock_errors(heartbeat)):
            typer.echo(line)
    if not heartbeats:
        typer.echo("no worker")
    for line in on_server((server, creds, ca), _stream_lines):
        typer.echo(line)
    if blocks is not None:
        _check_block_version(heartbeats, blocks)


def _refusals(heartbeat: "Heartbeat") -> list[str]:
    return [
        f"partition {each.partition}: {heartbeat.id} refuses it, because its checkpoint is of format "
        f"{each.format or 'unknown'}: start a worker of the version that wrote it"
        for each in heartbeat.refused
    ]


def _unknown_packs(heartbeat: "Heartbeat") -> list[str]:
    """Return a line for each listed pack that sends blocks without a valid row in the table."""
    lines = [
        f"{pack}: unknown pack that sends blocks, which wait: it is not in the table of packs, or its row is wrong; "
        "`fleet packs list` prints the errors, `fleet packs load` adds rows"
        for pack in heartbeat.unknown
    ]
    more = heartbeat.unknown_count - len(lines)
    return [*lines, f"{heartbeat.id}: {count_text(more, 'more unknown pack')}"] if more > 0 else lines


def _dead_letters(dead_packs: "DeadPacks") -> list[str]:
    lines = [
        f"{pack}: dead letter: {reason}; `fleet dead-letters list` lists all" for pack, reason in dead_packs.reasons
    ]
    more = dead_packs.packs - len(lines)
    return [*lines, f"{count_text(more, 'more pack')} with dead letters"] if more else lines


def _clock_errors(heartbeat: "Heartbeat") -> list[str]:
    """Return a line for each listed pack whose edge's clock is wrong, the largest error first."""
    if 2 * heartbeat.clock_error_count > heartbeat.packs > MIN_CLOCKS:
        clocks = count_text(heartbeat.clock_error_count, "edge")
        return [
            f"{heartbeat.id}: the clocks of {clocks} of {heartbeat.packs} differ from the server's: check the clocks of its nodes"
        ]
    largest = sorted(heartbeat.clock_errors.items(), key=lambda each: -abs(each[1]))
    lines = [
        f"{pack}: the clock of its edge is {timedelta(seconds=round(abs(error_s)))} "
        f"{'ahead' if error_s > 0.0 else 'behind'}: its hours are quarantined; `fleet ask clocks` lists them"
        for pack, error_s in largest
    ]
    more = heartbeat.clock_error_count - len(largest)
    return [*lines, f"{heartbeat.id}: {count_text(more, 'more pack')} with a wrong clock"] if more > 0 else lines


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


async def _stream_lines(nc: "Client") -> list[str]:
    """Return lines about dead letters and unsaved blocks; a line with the reason if the streams cannot be read."""
    from nats.errors import Error as NatsError  # noqa: PLC0415 - NATS is optional

    from bms_estimator.fleet.nats.dead_packs import DeadPackReader  # noqa: PLC0415
    from bms_estimator.fleet.nats.stream_reader import StreamError  # noqa: PLC0415
    from bms_estimator.fleet.nats.streams import partitions_of  # noqa: PLC0415
    from bms_estimator.fleet.nats.unsaved_blocks import unsaved_blocks  # noqa: PLC0415

    try:
        async with asyncio.timeout(STREAMS_TIMEOUT_S):
            partitions = await partitions_of(nc)
            if partitions is None:
                return ["the server has no streams yet: was `fleet serve` started?"]
            warning = (await unsaved_blocks(nc, range(partitions))).warning
            return [*_dead_letters(await DeadPackReader(nc).read()), *([warning] if warning else [])]
    except (TimeoutError, NatsError, StreamError, UserError) as error:
        hint = "in a cluster, are most nodes up? Is or was the disk full? Then free space and restart `fleet serve`"
        return [f"the streams cannot be read ({str(error) or 'no answer'}): {hint}"]


async def _receive_heartbeats(nc: "Client") -> "list[Heartbeat]":
    """Return the newest heartbeat of each worker, sorted by name, after two intervals. Report unreadable ones."""
    from pydantic import ValidationError  # noqa: PLC0415 - loading takes time

    from bms_estimator.edge import subjects  # noqa: PLC0415 - NATS is optional
    from bms_estimator.fleet.heartbeat import HEARTBEAT_S, Heartbeat  # noqa: PLC0415

    newest, unreadable = dict[str, Heartbeat](), set[str]()
    subscription = await nc.subscribe(subjects.worker())
    await asyncio.sleep(2.0 * HEARTBEAT_S)
    while subscription.pending_msgs:
        message = await subscription.next_msg()
        try:
            heartbeat = Heartbeat.model_validate_json(message.data)
        except ValidationError:
            unreadable.add(message.subject)
        else:
            newest[heartbeat.id] = heartbeat
    for subject in sorted(unreadable):
        typer.echo(f"warning: the heartbeat on {subject} is unreadable: is this worker of a later version?", err=True)
    return [newest[name] for name in sorted(newest) if not newest[name].leaving]
