"""``bms-estimator fleet capture``: table of a pack's stored samples."""

import math
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bms_estimator.cli.fleet.server_options import DEFAULT_SERVER, Ca, Creds, Server, on_server
from bms_estimator.cli.options.capture_options import Force, check_output_file
from bms_estimator.cli.options.table import count_text
from bms_estimator.model.clock import iso_utc
from bms_estimator.model.columns import cell_voltage_columns
from bms_estimator.model.errors import UserError
from bms_estimator.sinks.trace_file import join_columns, table_sink

if TYPE_CHECKING:
    from bms_estimator.fleet.nats.block_capture import BlockCapture

TIME_EXAMPLE = "2026-01-31 or 2026-01-31T12:00"
"""Example of a start time in help texts."""
TIME_FORMATS = ["%Y-%m-%d", "%Y-%m-%dT%H:%M", "%Y-%m-%dT%H:%M:%S"]
"""Formats of start and end time."""
MAX_SHOWN_GAPS = 5
"""Maximum number of printed gaps."""
MAX_START_DELAY_S = 120.0
"""Maximum delay of the first block after the requested start without a warning [s]: two blocks of a minute."""

Since = Annotated[
    datetime | None,
    typer.Option(
        "--from",
        formats=TIME_FORMATS,
        metavar="TIME",
        help=f"start time in UTC: {TIME_EXAMPLE}; default: the oldest stored sample",
    ),
]
Until = Annotated[
    datetime | None,
    typer.Option(
        "--to",
        formats=TIME_FORMATS,
        metavar="TIME",
        help="end time in UTC, exclusive; default: the newest stored sample",
    ),
]


def capture(
    pack: Annotated[str, typer.Argument(help="name of the pack", show_default=False)],
    out: Annotated[Path, typer.Argument(help="file to write: .parquet, .csv.gz or .csv", show_default=False)],
    since: Since = None,
    until: Until = None,
    server: Server = DEFAULT_SERVER,
    creds: Creds = None,
    ca: Ca = None,
    force: Force = False,
) -> None:
    """Write a pack's stored samples to a file that `replay`, `identify`, `validate` and `capacity` can read.

    Cell voltages, if the edge sends them, are in the columns cell_1_v, cell_2_v and so on.
    The server stores samples for some days (setting `server.outage_days`). They are written in the order in which the edge sent them.
    To reproduce the workers' estimates, run `replay` with the settings that `fleet packs show PACK --out FOLDER` writes.
    """
    check_output_file(out, [], force=force)
    sink = table_sink(out)
    from bms_estimator.fleet.nats.block_capture import fetch  # noqa: PLC0415 - NATS is optional

    since_s, until_s = epoch_s(since, -math.inf), epoch_s(until, math.inf)
    fetched = on_server((server, creds, ca), lambda nc: fetch(nc, pack, since_s=since_s, until_s=until_s))
    if not fetched.blocks:
        raise UserError(no_samples_reason(pack, fetched))
    rows = 0
    with sink:
        for samples, cells_v in fetched.samples_with_cells():
            sink.write(
                join_columns(samples[fetched.columns], cell_voltage_columns(cells_v, samples.size, fetched.cells))
            )
            rows += samples.size
    first_s, last_s = fetched.span_s
    typer.echo(
        f"{out}: {count_text(rows, 'sample')} in {count_text(fetched.blocks, 'block')} of {pack}, {iso_utc(first_s)} to {iso_utc(last_s)}"
    )
    for line in _warnings(fetched, since_s):
        typer.echo(f"warning: {pack}: {line}", err=True)


def epoch_s(time: datetime | None, default_s: float) -> float:
    """Convert a UTC time to seconds since 1970; return ``default_s`` for None."""
    return default_s if time is None else time.replace(tzinfo=UTC).timestamp()


def no_samples_reason(pack: str, fetched: "BlockCapture") -> str:
    """Return the error text for a pack without samples."""
    damaged = f"; {fetched.damaged} of its messages are damaged" if fetched.damaged else ""
    return (
        f"{pack}: the server has no samples of this pack in this period{damaged}; check its name, and whether its edge sends "
        "(`fleet packs list` prints the names; server.outage_days limits the age of stored samples)"
    )


def _warnings(fetched: "BlockCapture", since_s: float) -> list[str]:
    first_s, _ = fetched.span_s
    lines = []
    if since_s > -math.inf and first_s > since_s + MAX_START_DELAY_S:
        lines.append(f"the stored samples begin at {iso_utc(first_s)}, after the requested {iso_utc(since_s)}")
    if fetched.missing:
        gaps = ", ".join(f"{a} to {b}" if b > a else f"{a}" for a, b in fetched.missing[:MAX_SHOWN_GAPS])
        more_count = len(fetched.missing) - MAX_SHOWN_GAPS
        more = f" and {count_text(more_count, 'more gap')}" if more_count > 0 else ""
        lines.append(f"missing blocks: {gaps}{more}; they are lost, or the edge has yet to send them again")
    if fetched.damaged:
        lines.append(f"damaged messages, which were skipped: {fetched.damaged}")
    return lines
