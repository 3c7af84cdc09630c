"""``bms-estimator fleet identify``: re-identification of packs from their stored samples."""

import asyncio
import csv
import io
import json
import math
import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich import box
from rich.console import Console
from rich.table import Table

from bms_estimator.cli.fleet.capture import Since, Until, epoch_s
from bms_estimator.cli.fleet.packs import known_packs, refuse_unknown
from bms_estimator.cli.fleet.server_options import SERVER, Ca, Creds, Server, ServerAddress
from bms_estimator.cli.options.capture_options import AsJson, Force, check_output_file
from bms_estimator.cli.options.number_options import whole
from bms_estimator.edge.subjects import CELLS_BUCKET, PACKS_BUCKET
from bms_estimator.fleet.packs.pack_registry import PackRegistry
from bms_estimator.fleet.packs.pack_row import PackSpec, encode_row
from bms_estimator.model.config_file import write_text
from bms_estimator.model.errors import UserError

if TYPE_CHECKING:
    from bms_estimator.fleet.identification.reidentify import ReidentificationResult

RESULTS = "results.csv"
"""Name of the file with the results of all packs."""


def identify(
    packs: Annotated[list[str] | None, typer.Argument(help="names of packs", show_default=False)] = None,
    from_file: Annotated[
        Path | None,
        typer.Option(
            help="file with names of packs: one name a line, or a CSV file with the column pack", show_default=False
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="folder for the cell files and results.csv")] = Path("identified"),
    put: Annotated[
        bool, typer.Option("--put", help="upload the new cell files, which the workers then use at once")
    ] = False,
    since: Since = None,
    until: Until = None,
    processes: Annotated[
        int | None,
        typer.Option(
            parser=whole(1), help="number of parallel processes; default: one for each CPU", show_default=False
        ),
    ] = None,
    server: Server = SERVER,
    creds: Creds = None,
    ca: Ca = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Re-identify the cells of packs from their stored samples on the server.

    A new cell is identified from the first two thirds of a pack's samples.
    The voltages that the old and the new cell predict are then compared with the last third.
    A cell file is written only if the new cell predicts better; otherwise the reason is printed.
    """
    address = (server, creds, ca)
    names = _names(packs or [], from_file)
    check_output_file(out / RESULTS, [], force=force)
    known = asyncio.run(known_packs(address))
    refuse_unknown(names, known)
    results = list["ReidentificationResult"]()
    for outcome in _outcomes(names, known, (epoch_s(since, -math.inf), epoch_s(until, math.inf)), address, processes):
        results.append(outcome)
        if outcome.cell_file:
            write_text(out / f"{outcome.pack}.toml", outcome.cell_file, make_folder=True)
        if sys.stderr.isatty():
            typer.echo(f"{len(results)} of {len(names)}: {outcome.pack}", err=True)
    _write_results(out / RESULTS, results)
    changed = asyncio.run(_put(results, known, address)) if put else []
    if as_json:
        typer.echo(json.dumps([_row(one) for one in results]))
    else:
        better = sum(bool(one.cell_file) for one in results)
        typer.echo(f"{out}: {better} of {len(results)} packs have a better cell")
        Console().print(_table(results))
    for pack in changed:
        typer.echo(
            f"warning: {pack}: another client changed its row in the meantime; its new cell was not uploaded", err=True
        )


def _outcomes(
    names: Sequence[str],
    known: PackRegistry,
    span_s: tuple[float, float],
    address: ServerAddress,
    processes: int | None,
) -> Iterator["ReidentificationResult"]:
    from bms_estimator.fleet.identification.batch import Task, reidentify_all  # noqa: PLC0415 - needs NATS
    from bms_estimator.fleet.identification.reidentify import ReidentificationResult  # noqa: PLC0415 - slow to import

    tasks, (server, creds, ca) = [], address
    for name in names:
        kind = known.kind(name)
        if isinstance(kind, PackSpec) and not known.reason(name):
            tasks.append(Task(name, kind, known.cell_file(kind.cell), *span_s, server, creds, ca))
        else:
            yield ReidentificationResult(name, reason=known.reason(name))
    yield from reidentify_all(tasks, processes or os.cpu_count() or 1)


def _names(packs: Sequence[str], from_file: Path | None) -> list[str]:
    """Return the names of the command line and the file, in order, without duplicates.

    Raises:
        UserError: There is no name, or the file cannot be read.
    """
    names = [*packs, *(_listed(from_file) if from_file is not None else [])]
    if not names:
        raise UserError("name at least one pack, or give --from-file LIST")
    return list(dict.fromkeys(names))


def _listed(path: Path) -> list[str]:
    """Return the column ``pack`` of a CSV file, or its first column."""
    try:
        rows = [row for row in csv.reader(path.read_text(encoding="utf-8-sig").splitlines()) if row and row[0].strip()]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"--from-file {path}: cannot be read: {error}") from None
    column = rows[0].index("pack") if rows and "pack" in rows[0] else None
    listed = rows if column is None else rows[1:]
    return [row[column or 0].strip() for row in listed if len(row) > (column or 0) and not row[0].startswith("#")]


async def _put(results: Sequence["ReidentificationResult"], known: PackRegistry, address: ServerAddress) -> list[str]:
    """Upload new cells and the rows that name them. Return the packs whose rows another client has changed."""
    from bms_estimator.fleet.identification.reidentify import cell_name  # noqa: PLC0415
    from bms_estimator.fleet.nats.one_shot_connection import connected  # noqa: PLC0415 - NATS is optional
    from bms_estimator.fleet.packs.pack_bucket import put, read_bucket  # noqa: PLC0415

    cells, rows, changed = dict[str, bytes](), dict[str, bytes](), list[str]()
    async with connected(*address) as nc:
        stored_rows = await read_bucket(nc, PACKS_BUCKET)
        for one in results:
            kind = known.kind(one.pack)
            if not one.cell_file or not isinstance(kind, PackSpec):
                continue
            if stored_rows.get(one.pack) != encode_row(kind):
                changed.append(one.pack)
                continue
            name = cell_name(one.pack)
            cells[name] = one.cell_file.encode()
            rows[one.pack] = encode_row(kind.model_copy(update={"cell": name, "capacity_ah": None}))
        await put(nc, CELLS_BUCKET, cells)
        await put(nc, PACKS_BUCKET, rows)
    return changed


def _row(one: "ReidentificationResult") -> dict[str, object]:
    """Return the row for JSON, with None for missing numbers."""
    values = asdict(one) | {"better": bool(one.cell_file)}
    del values["cell_file"]
    return {
        name: value if not isinstance(value, float) or math.isfinite(value) else None for name, value in values.items()
    }


def _write_results(path: Path, results: Sequence["ReidentificationResult"]) -> None:
    rows, table = list(map(_row, results)), io.StringIO()
    writer = csv.DictWriter(table, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(path, table.getvalue(), make_folder=True)


def _table(results: Sequence["ReidentificationResult"]) -> Table:
    """Return a table of the values before and after."""
    table = Table(box=box.SIMPLE_HEAD)
    # the backslash keeps rich from reading a unit as markup
    for column in ("pack", "hours", "Ah", "R_s \\[mohm]", "RMS \\[mV]", "method", "reason"):
        table.add_column(column, justify="left" if column in ("pack", "method", "reason") else "right")
    for one in results:
        table.add_row(
            one.pack,
            _number(one.hours, 1),
            _change(one.capacity_before_ah, one.capacity_ah, one.capacity_std_ah, 1.0),
            _change(one.r_s_before_ohm, one.r_s_ohm, math.nan, 1e3),
            _change(one.rms_before_v, one.rms_v, math.nan, 1e3),
            one.method if one.cell_file else "",
            one.reason,
        )
    return table


def _change(before: float, after: float, std: float, factor: float) -> str:
    if not math.isfinite(after):
        return _number(factor * before, 3) if math.isfinite(before) else "-"
    uncertainty = f" ± {factor * std:.2g}" if math.isfinite(std) else ""
    return f"{factor * before:.4g} to {factor * after:.4g}{uncertainty}"


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"
