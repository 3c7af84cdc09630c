"""``bms-estimator fleet checkpoints``: stored states of the partitions."""

from collections import defaultdict
from datetime import UTC, date, datetime
from typing import TYPE_CHECKING, Annotated

import typer

from bms_estimator.cli.fleet.server_options import DEFAULT_SERVER, Ca, Creds, Server, on_server
from bms_estimator.cli.options.table import print_table

if TYPE_CHECKING:
    from collections.abc import Iterable

    from bms_estimator.fleet.nats.checkpoint_pointer import CheckpointInfo, CheckpointPointer

DAY_COLUMNS: tuple[str, ...] = ("day", "partitions", "MB")
COLUMNS = ("kind", "written (UTC)", "sequence", "format", "increments", "MB")

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    help="List the checkpoints, which contain the states of all packs, or return to those of an earlier day.",
)


@app.command("list")
def list_checkpoints(
    partition: Annotated[
        int | None, typer.Option(help="list the checkpoints of this partition", show_default=False)
    ] = None,
    server: Server = DEFAULT_SERVER,
    creds: Creds = None,
    ca: Ca = None,
) -> None:
    """Print the days with daily checkpoints and their number of partitions, or all checkpoints of one partition."""
    from bms_estimator.fleet.worker.checkpoint.admin_changes import read_pointers  # noqa: PLC0415 - NATS is optional

    pointers = on_server((server, creds, ca), read_pointers)
    if partition is None:
        columns, rows = DAY_COLUMNS, _day_rows(pointers.values())
    else:
        columns, rows = COLUMNS, _rows(pointers[partition]) if partition in pointers else []
    print_table(columns, rows)
    if not rows:
        typer.echo("none")


@app.command()
def restore(
    day: Annotated[datetime, typer.Option(formats=["%Y-%m-%d"], help="UTC day")],
    partition: Annotated[
        list[int] | None, typer.Option(help="number of a partition, repeatable; default: all", show_default=False)
    ] = None,
    skip_blocks: Annotated[
        bool, typer.Option("--skip-blocks", help="do not process the blocks after the checkpoint again")
    ] = False,
    server: Server = DEFAULT_SERVER,
    creds: Creds = None,
    ca: Ca = None,
) -> None:
    """Reset all packs of the chosen partitions to the first checkpoint of a day.

    The workers then process again the later blocks that are still in the stream. If wrong samples have spoiled the states, use
    --skip-blocks.
    """
    from bms_estimator.fleet.worker.checkpoint.admin_changes import restore_day  # noqa: PLC0415 - NATS is optional

    chosen = on_server(
        (server, creds, ca), lambda nc: restore_day(nc, day.date(), partition or (), skip_blocks=skip_blocks)
    )
    for number, info in sorted(chosen.items()):
        typer.echo(f"partition {number}: returned to the checkpoint of {_time(info)} UTC")


def _day_rows(pointers: "Iterable[CheckpointPointer]") -> list[tuple[object, ...]]:
    """Return a row for each day, the newest first."""
    from bms_estimator.fleet.worker.checkpoint.admin_changes import day_of  # noqa: PLC0415 - NATS is optional

    sizes = defaultdict[date, list[int]](list)
    for pointer in pointers:
        for info in pointer.daily:
            sizes[day_of(info)].append(info.bytes)
    return [(day, len(sizes[day]), _megabytes(sum(sizes[day]))) for day in sorted(sizes, reverse=True)]


def _rows(pointer: "CheckpointPointer") -> list[tuple[object, ...]]:
    kinds = [*zip(("last", "previous"), pointer.kept, strict=False), *(("daily", info) for info in pointer.daily)]
    return [
        (
            kind,
            _time(info),
            info.sequence,
            info.format,
            len(info.increments),
            _megabytes(info.bytes + info.increment_bytes),
        )
        for kind, info in kinds
    ]


def _time(info: "CheckpointInfo") -> str:
    return f"{datetime.fromtimestamp(info.made_s, UTC):%Y-%m-%d %H:%M:%S}"


def _megabytes(size: int) -> str:
    return f"{size / 1e6:,.1f}"
