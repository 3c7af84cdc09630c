"""``bms-estimator fleet packs``: table of packs and their cells."""

import sys
from collections.abc import Collection, Container
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tomlkit
import typer

from bms_estimator.cli.fleet.server_options import DEFAULT_SERVER, Ca, Creds, Server, ServerAddress, on_server
from bms_estimator.cli.options.table import count_text
from bms_estimator.edge.subjects import CELLS_BUCKET, PACKS_BUCKET
from bms_estimator.fleet.packs.csv_table import CELL_FILE_SUFFIX, PackTable, check_models, read_table, table_lines
from bms_estimator.fleet.packs.pack_registry import PackRegistry
from bms_estimator.fleet.packs.pack_row import PackSpec, model_key, settings_of
from bms_estimator.model.config_file import write_text
from bms_estimator.model.errors import UserError

if TYPE_CHECKING:
    from nats.aio.client import Client

    from bms_estimator.fleet.worker.checkpoint.admin_changes import Erasure

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    help="Upload, list, show or remove the settings of packs in the server's table.",
)


@app.command()
def load(
    table: Annotated[
        Path,
        typer.Argument(
            help="CSV file with the columns pack, cell, capacity_ah, series ... (docs/fleet/index.md)",
            show_default=False,
        ),
    ],
    server: Server = DEFAULT_SERVER,
    creds: Creds = None,
    ca: Ca = None,
    remove: Annotated[
        bool, typer.Option("--remove", help="remove packs from the server that are not in this file")
    ] = False,
) -> None:
    """Upload a table of packs to the server; unchanged rows are not written again.

    Workers apply changes within seconds. A cell whose name ends in .toml is a cell file in the folder of the table.
    """
    packs = read_table(table)
    files = {name: _read_text(path) for name, path in packs.cell_files.items()}
    typer.echo(on_server((server, creds, ca), lambda nc: _load(nc, table, packs, files, remove=remove)))


@app.command("list")
def list_packs(server: Server = DEFAULT_SERVER, creds: Creds = None, ca: Ca = None) -> None:
    """Print the server's table of packs as CSV, which `load` can read; errors in rows are printed to stderr."""
    registry = on_server((server, creds, ca), fetch_registry)
    specs = {pack: spec for pack in sorted(registry) if isinstance(spec := registry.parsed_row(pack), PackSpec)}
    invalid_packs = [pack for pack in sorted(registry) if pack not in specs]
    # packs with equal models have equal errors, so that only the first pack of each model is checked
    first_packs = {model_key(spec): pack for pack, spec in reversed(specs.items())}
    for pack in (*invalid_packs, *first_packs.values()):
        if reason := registry.reason(pack):
            typer.echo(f"warning: {pack}: {reason}", err=True)
    sys.stdout.writelines(table_lines(specs))


@app.command()
def remove(
    packs: Annotated[list[str], typer.Argument(help="names of packs", show_default=False)],
    server: Server = DEFAULT_SERVER,
    creds: Creds = None,
    ca: Ca = None,
    erase: Annotated[
        bool, typer.Option("--erase", help="also erase their blocks, dead letters, states and hourly summaries")
    ] = False,
    folder: Annotated[
        Path | None,
        typer.Option(
            help="with --erase: also erase their rows from this folder of `fleet collect`, which must not run meanwhile",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Remove packs from the server's table; samples that they send later are stored but not estimated.

    The command prints which data of the packs remain.
    """
    names, address = dict.fromkeys(packs), (server, creds, ca)
    if erase:
        _erase(list(names), address, folder)
        return
    if folder is not None:
        raise UserError("--folder: give it together with --erase")
    on_server(address, lambda nc: _remove(nc, set(names)))
    typer.echo(f"removed from the table: {', '.join(names)}")
    typer.echo("their blocks, states and hourly summaries remain; --erase erases them")


@app.command()
def show(
    pack: Annotated[str, typer.Argument(help="name of the pack", show_default=False)],
    server: Server = DEFAULT_SERVER,
    creds: Creds = None,
    ca: Ca = None,
    out: Annotated[
        Path | None,
        typer.Option(help="write pack.toml and the cell file to this folder instead of printing", show_default=False),
    ] = None,
) -> None:
    """Print a pack's settings as a pack file; `replay --pack` with this file reproduces the workers' estimates."""
    registry = on_server((server, creds, ca), fetch_registry)
    reject_unknown([pack], registry)
    files = pack_files(pack, registry)
    if out is None:
        typer.echo(files["pack.toml"].rstrip())
        return
    for name, text in files.items():
        write_text(out / name, text, make_folder=True)
    typer.echo(f"{out}: {' and '.join(files)} written")


def pack_files(pack: str, registry: PackRegistry) -> dict[str, str]:
    """Return contents by file name: the pack file, and the cell file unless the cell is shipped.

    Raises:
        UserError: The row or its cell is invalid.
    """
    spec = registry.parsed_row(pack)
    if not isinstance(spec, PackSpec) or registry.reason(pack):
        raise UserError(f"{pack}: {registry.reason(pack)}")
    settings = settings_of(spec).model_dump(mode="json", exclude_unset=True)
    cell_text = registry.cell_file(spec.cell)
    cell = spec.cell if cell_text is None else f"{spec.cell}{CELL_FILE_SUFFIX}"
    settings["pack"] |= {"name": pack, "cell": cell}
    return {"pack.toml": tomlkit.dumps(settings)} | ({} if cell_text is None else {cell: cell_text})


def reject_unknown(packs: Collection[str], registry: Container[str]) -> None:
    """Check that each pack is in the table.

    Raises:
        UserError: A pack is unknown.
    """
    unknown = [pack for pack in packs if pack not in registry]
    if unknown:
        raise UserError(f"{', '.join(unknown)}: not in the table of packs; `fleet packs list` prints it")


async def fetch_registry(nc: "Client") -> PackRegistry:
    """Return the server's table of packs and cells."""
    from bms_estimator.fleet.packs.pack_bucket import PackBucket  # noqa: PLC0415 - NATS is optional

    bucket = PackBucket(nc)
    await bucket.refresh()
    return bucket.packs


async def _load(nc: "Client", path: Path, table: PackTable, files: dict[str, str], *, remove: bool) -> str:
    from bms_estimator.fleet.nats.bucket_reader import read_bucket  # noqa: PLC0415
    from bms_estimator.fleet.packs.pack_bucket import write_bucket  # noqa: PLC0415

    stored_cells = {name: data.decode(errors="replace") for name, data in (await read_bucket(nc, CELLS_BUCKET)).items()}
    check_models(path, table, stored_cells | files)
    cells = await write_bucket(nc, CELLS_BUCKET, {name: text.encode() for name, text in files.items()})
    rows = {name: line.data for name, line in table.packs.items()}
    packs = await write_bucket(nc, PACKS_BUCKET, rows, remove=remove)
    spec_count = len(set(rows.values()))
    counts = {
        "new": packs.new,
        "changed": packs.changed,
        "unchanged": packs.same,
        "removed": packs.removed,
        "not in the table (--remove removes them)": packs.left,
    }
    changes = [f"{count} {change}" for change, count in counts.items() if count]
    if written := cells.new + cells.changed:
        changes.append(f"{count_text(written, 'cell file')} written")
    return f"{path}: {count_text(len(rows), 'pack')} of {count_text(spec_count, 'kind')}: {', '.join(changes)}"


def _erase(packs: list[str], address: ServerAddress, folder: Path | None) -> None:
    """Erase packs from the server and from the Parquet files, and print what was erased and what remains."""
    from bms_estimator.fleet.nats.stream_sizes import DAILY_CHECKPOINTS  # noqa: PLC0415
    from bms_estimator.fleet.queries.collector import only_collector  # noqa: PLC0415 - its packages are optional
    from bms_estimator.fleet.queries.row_erasure import erase_rows  # noqa: PLC0415
    from bms_estimator.fleet.worker.checkpoint.admin_changes import erase_packs  # noqa: PLC0415

    def erase_on_server() -> None:
        _print_erasures(on_server(address, lambda nc: erase_packs(nc, set(packs))))

    if folder is None:
        erase_on_server()
    else:
        if not folder.is_dir():
            raise UserError(f"--folder {folder}: no such folder")
        with only_collector(folder):  # before anything is erased
            erase_on_server()
            try:
                typer.echo(f"{folder}: {count_text(erase_rows(folder, packs), 'row')} erased")
            except OSError as error:
                raise UserError(f"--folder {folder}: cannot be written, repeat the command: {error.strerror}") from None
    remaining: list[str] = []
    if folder is None:
        remaining.append("their rows in the Parquet files of `fleet collect`: end it and repeat with --folder FOLDER")
    remaining += [
        "blocks on their edges, which they send again: stop the edges, revoke their tokens, delete PACK.edge.sqlite",
        f"earlier checkpoints in the server's files OBJ_states, for at most {DAILY_CHECKPOINTS} days while workers save",
        "former rows in the server's files KV_packs, until most rows of such a file of 4 MB were changed or removed",
        "last states on running fleet pages, until these are restarted",
        "backups of the server and of the Parquet files, files of `fleet capture`, logs of workers",
    ]
    typer.echo("\n  ".join(["remaining:", *remaining]))


def _print_erasures(erasures: "dict[str, Erasure]") -> None:
    for pack, erasure in erasures.items():
        typer.echo(
            f"{pack}: {count_text(erasure.blocks, 'block')}, {count_text(erasure.dead_letters, 'dead letter')}, "
            f"{count_text(erasure.hours, 'hourly summary', 'hourly summaries')} and "
            f"the state in {count_text(erasure.checkpoints, 'checkpoint')} erased"
        )
        for stream, count in erasure.remaining.items():
            typer.echo(f"{pack}: remaining messages in the stream {stream}: {count}")


async def _remove(nc: "Client", packs: set[str]) -> None:
    from bms_estimator.fleet.nats.bucket_reader import read_bucket  # noqa: PLC0415
    from bms_estimator.fleet.packs.pack_bucket import remove_keys  # noqa: PLC0415

    reject_unknown(packs, await read_bucket(nc, PACKS_BUCKET))
    await remove_keys(nc, PACKS_BUCKET, packs)


def _read_text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: cannot be read: {error}") from None
