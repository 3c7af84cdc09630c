"""``bms-estimator fleet identify``: re-identification of packs from their stored samples."""

import asyncio
import csv
import io
import json
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich import box
from rich.console import Console
from rich.table import Table

from bms_estimator.cli.fleet.capture import Since, Until, epoch_s
from bms_estimator.cli.fleet.packs import fetch_registry, reject_unknown
from bms_estimator.cli.fleet.server_options import DEFAULT_SERVER, Ca, Creds, Server, ServerAddress
from bms_estimator.cli.options.capture_options import AsJson, Force, check_output_file
from bms_estimator.cli.options.number_options import whole
from bms_estimator.cli.options.progress_bar import progress_bar
from bms_estimator.edge.subjects import CELLS_BUCKET, PACKS_BUCKET
from bms_estimator.fleet.packs.pack_registry import PackRegistry
from bms_estimator.fleet.packs.pack_row import PackSpec, encode_row
from bms_estimator.model.config_file import write_text
from bms_estimator.model.errors import UserError

if TYPE_CHECKING:
    from bms_estimator.fleet.identification.reidentify import ReidentificationResult

RESULTS_FILE = "results.csv"
"""Name of the file with the results of all packs."""


def identify(
    packs: Annotated[list[str] | None, typer.Argument(help="names of packs", show_default=False)] = None,
    from_file: Annotated[
        Path | None,
        typer.Option(
            help="file with names of packs: one name a line, or a CSV file with a column `pack`", show_default=False
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
    server: Server = DEFAULT_SERVER,
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
    if out.exists():
        check_output_file(out / RESULTS_FILE, [], force=force)
    registry = asyncio.run(fetch_registry(address))
    reject_unknown(names, registry)
    span_s = (epoch_s(since, -math.inf), epoch_s(until, math.inf))
    results = list["ReidentificationResult"]()
    with progress_bar("identifying") as bar:
        for result in _reidentify(names, registry, span_s, address, processes):
            results.append(result)
            if result.cell_file:
                write_text(out / f"{result.pack}.toml", result.cell_file, make_folder=True)
            bar.update(len(results) / len(names), f"{len(results)} of {len(names)} packs identified")
    _write_results(out / RESULTS_FILE, results)
    changed_packs = asyncio.run(_upload(results, registry, address)) if put else []
    if as_json:
        typer.echo(json.dumps([_json_row(result) for result in results]))
    else:
        better_count = sum(bool(result.cell_file) for result in results)
        typer.echo(f"{out}: {better_count} of {len(results)} packs have a better cell")
        Console().print(_table(results))
    for pack in changed_packs:
        typer.echo(
            f"warning: {pack}: another client changed its row in the meantime; its new cell was not uploaded", err=True
        )


def _reidentify(
    names: Sequence[str],
    registry: PackRegistry,
    span_s: tuple[float, float],
    address: ServerAddress,
    processes: int | None,
) -> Iterator["ReidentificationResult"]:
    """Yield the result of each pack as soon as it is known; a pack with an invalid row or cell only has a reason.

    Args:
        names: Names of the packs.
        registry: Table of packs and cells.
        span_s: First and last time of the samples [s since 1970].
        address: Address and credentials of the server.
        processes: Number of parallel processes; None: one for each CPU.
    """
    from bms_estimator.fleet.identification.batch import Task, reidentify_all  # noqa: PLC0415 - needs NATS
    from bms_estimator.fleet.identification.reidentify import ReidentificationResult  # noqa: PLC0415 - slow to import

    tasks, (server, creds, ca) = [], address
    for name in names:
        spec = registry.parsed_row(name)
        if isinstance(spec, PackSpec) and not registry.reason(name):
            tasks.append(Task(name, spec, registry.cell_file(spec.cell), *span_s, server, creds, ca))
        else:
            yield ReidentificationResult(name, reason=registry.reason(name))
    yield from reidentify_all(tasks, processes or os.cpu_count() or 1)


def _names(packs: Sequence[str], from_file: Path | None) -> list[str]:
    """Return the names of the command line and the file, in order, without duplicates.

    Raises:
        UserError: There is no name, or the file cannot be read.
    """
    names = [*packs, *(_names_in_file(from_file) if from_file is not None else [])]
    if not names:
        raise UserError("name at least one pack, or give --from-file LIST")
    return list(dict.fromkeys(names))


def _names_in_file(path: Path) -> list[str]:
    """Return the column ``pack`` of a CSV file; without a header that has this column, the first column."""
    try:
        rows = [row for row in csv.reader(path.read_text(encoding="utf-8-sig").splitlines()) if row and row[0].strip()]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"--from-file {path}: cannot be read: {error}") from None
    has_header = bool(rows) and "pack" in rows[0]
    column = rows[0].index("pack") if has_header else 0
    data_rows = rows[1:] if has_header else rows
    return [row[column].strip() for row in data_rows if len(row) > column and not row[0].startswith("#")]


async def _upload(
    results: Sequence["ReidentificationResult"], registry: PackRegistry, address: ServerAddress
) -> list[str]:
    """Upload new cells and the rows that name them. Return the packs whose rows another client has changed."""
    from bms_estimator.fleet.identification.reidentify import cell_name  # noqa: PLC0415
    from bms_estimator.fleet.nats.one_shot_connection import connected  # noqa: PLC0415 - NATS is optional
    from bms_estimator.fleet.packs.pack_bucket import put, read_bucket  # noqa: PLC0415

    cells, rows, changed_packs = dict[str, bytes](), dict[str, bytes](), list[str]()
    async with connected(*address) as nc:
        stored_rows = await read_bucket(nc, PACKS_BUCKET)
        for result in results:
            spec = registry.parsed_row(result.pack)
            if not result.cell_file or not isinstance(spec, PackSpec):
                continue
            if stored_rows.get(result.pack) != encode_row(spec):
                changed_packs.append(result.pack)
                continue
            name = cell_name(result.pack)
            cells[name] = result.cell_file.encode()
            # the new cell file contains the capacity and its std
            new_cell = {"cell": name, "capacity_ah": None, "capacity_std": None}
            rows[result.pack] = encode_row(spec.model_copy(update=new_cell))
        await put(nc, CELLS_BUCKET, cells)
        await put(nc, PACKS_BUCKET, rows)
    return changed_packs


def _json_row(result: "ReidentificationResult") -> dict[str, object]:
    """Return the fields of a result for JSON and CSV, with None for missing numbers."""
    values = asdict(result) | {"better": bool(result.cell_file)}
    del values["cell_file"]
    return {
        name: value if not isinstance(value, float) or math.isfinite(value) else None for name, value in values.items()
    }


def _write_results(path: Path, results: Sequence["ReidentificationResult"]) -> None:
    rows, table = list(map(_json_row, results)), io.StringIO()
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
    for result in results:
        table.add_row(
            result.pack,
            _fixed_point(result.hours, 1),
            _change(result.capacity_before_ah, result.capacity_ah, std=result.capacity_std_ah),
            _change(result.r_s_before_ohm, result.r_s_ohm, factor=1e3),
            _change(result.rms_before_v, result.rms_v, factor=1e3),
            result.method if result.cell_file else "",
            result.reason,
        )
    return table


def _change(before: float, after: float, *, std: float = math.nan, factor: float = 1.0) -> str:
    """Return both values, times ``factor``, and the standard deviation of the second; a missing value is omitted."""
    if not math.isfinite(after):
        return _fixed_point(factor * before, 3)
    uncertainty = f" ± {factor * std:.2g}" if math.isfinite(std) else ""
    return f"{factor * before:.4g} to {factor * after:.4g}{uncertainty}"


def _fixed_point(value: float, decimals: int) -> str:
    return f"{value:.{decimals}f}" if math.isfinite(value) else "-"
