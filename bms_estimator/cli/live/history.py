"""``bms-estimator history``: CSV export of a pack's stored history."""

import csv
import sys
import time
from collections.abc import Iterable, Sequence
from contextlib import nullcontext
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Annotated

import typer

from bms_estimator.cli.options.capture_options import Force, check_output_file
from bms_estimator.cli.options.pack_options import whole
from bms_estimator.model.clock import iso_utc
from bms_estimator.model.errors import UserError
from bms_estimator.process.state_folder import state_folder
from bms_estimator.settings.pack import load_settings
from bms_estimator.store.history import MINUTE_S, Minute
from bms_estimator.store.history_reader import HistoryReader, PastEvent

TIME_EXAMPLE = "2026-01-31 or 2026-01-31T12:00"
"""Example of a start time in help texts."""
TIME_FORMATS = ["%Y-%m-%d", "%Y-%m-%dT%H:%M", "%Y-%m-%dT%H:%M:%S"]
"""Formats of start and end time."""


def history(
    pack: Annotated[Path, typer.Argument(help="settings file of the pack, pack.toml")],
    since: Annotated[
        datetime | None,
        typer.Option(
            formats=TIME_FORMATS, metavar="TIME", help=f"start time in UTC: {TIME_EXAMPLE}; default: the oldest row"
        ),
    ] = None,
    until: Annotated[
        datetime | None,
        typer.Option(formats=TIME_FORMATS, metavar="TIME", help="end time in UTC, exclusive; default: now"),
    ] = None,
    step: Annotated[
        int, typer.Option(parser=whole(MINUTE_S), help="interval of the rows in seconds, a multiple of 60")
    ] = MINUTE_S,
    events: Annotated[
        bool, typer.Option("--events", help="print events instead of means, extremes and totals")
    ] = False,
    folder: Annotated[
        Path | None,
        typer.Option(
            help="state folder of the service; default: state.folder of the settings, otherwise the user's state folder"
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="CSV file to write; default: stdout")] = None,
    force: Force = False,
) -> None:
    """Print a pack's stored history as CSV: means, extremes and totals of intervals of a minute or more.

    The service may be running. In column names, out means discharge and in means charge.
    """
    if step % MINUTE_S:
        raise UserError(f"--step {step}: must be a multiple of {MINUTE_S} s")
    settings = load_settings(pack)
    path = (folder or state_folder(settings)) / f"{settings.pack.name}.sqlite"
    if out is not None:
        check_output_file(out, [pack, path], force=force)
    since_s = since.replace(tzinfo=UTC).timestamp() if since else 0.0
    until_s = until.replace(tzinfo=UTC).timestamp() if until else time.time() + MINUTE_S
    header: Sequence[str] = PastEvent._fields if events else Minute._fields
    history_file = HistoryReader(path)
    rows = history_file.events(since_s, until_s) if events else history_file.rows(since_s, until_s, step)
    try:
        with out.open("w", encoding="utf-8", newline="") if out else nullcontext(sys.stdout) as table:
            _write_csv(table, header, rows)
    except OSError as error:
        if out is None:
            raise
        raise UserError(f"--out {out}: cannot be written: {error.strerror}") from error


def _write_csv(file: IO[str], header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write rows as CSV, with times as ISO 8601 text and floats with six significant digits."""
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(["time", *header[1:]])
    for time_s, *values in rows:
        shortened = (f"{value:.6g}" if isinstance(value, float) else value for value in values)
        writer.writerow([iso_utc(float(str(time_s))), *shortened])
