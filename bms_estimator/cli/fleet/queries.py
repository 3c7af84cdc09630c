"""``bms-estimator fleet collect`` and ``fleet ask``: storing and querying of hourly summaries."""

import asyncio
import sys
from csv import writer
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bms_estimator.cli.fleet.server_options import DEFAULT_SERVER, Ca, Creds, Server, ServerAddress
from bms_estimator.cli.options.table import count_text, print_table
from bms_estimator.model.errors import UserError

if TYPE_CHECKING:
    from bms_estimator.fleet.queries.duckdb_queries import Answer, Query

DEFAULT_FOLDER = Path("hours")
"""Default folder of the Parquet files."""


def collect(
    server: Server = DEFAULT_SERVER,
    creds: Creds = None,
    ca: Ca = None,
    folder: Annotated[Path, typer.Option(help="folder of the Parquet files")] = DEFAULT_FOLDER,
    period: Annotated[
        float, typer.Option(min=0.0, help="write a row to a file at most this many seconds after its arrival")
    ] = 300.0,
) -> None:
    """Write the hourly summaries of all packs, which the workers publish, to Parquet files, until SIGINT, SIGTERM or SIGHUP."""
    from bms_estimator.fleet.queries.collector import only_collector  # noqa: PLC0415 - its packages are optional
    from bms_estimator.process.runtime import configure_logs, flush_logs  # noqa: PLC0415

    configure_logs()
    with flush_logs(), only_collector(folder):
        asyncio.run(_collect((server, creds, ca), folder, period))


async def _collect(address: ServerAddress, folder: Path, period_s: float) -> None:
    from bms_estimator.fleet.nats.connection import connect, run_connected  # noqa: PLC0415
    from bms_estimator.fleet.queries.collector import Collector  # noqa: PLC0415
    from bms_estimator.process.runtime import stop_on_signal  # noqa: PLC0415

    stop, (server, creds, ca) = stop_on_signal(), address
    connection = connect(server, "collector", creds=creds, ca=ca)
    await run_connected(lambda nc: Collector(nc, folder, period_s=period_s).run(stop), stop, connection)


def repair(
    folder: Annotated[
        Path, typer.Option(help="folder to which `fleet collect` writes, which must not run meanwhile")
    ] = DEFAULT_FOLDER,
) -> None:
    """Repair rows that arrived while the clock of the server was wrong, as `fleet ask clocks` lists them."""
    from bms_estimator.fleet.queries.collector import only_collector  # noqa: PLC0415 - its packages are optional
    from bms_estimator.fleet.queries.row_erasure import repair_arrivals  # noqa: PLC0415

    if not folder.is_dir():
        raise UserError(f"--folder {folder}: no such folder")
    with only_collector(folder):
        typer.echo(f"{folder}: {count_text(repair_arrivals(folder), 'row')} repaired")


def ask(
    name: Annotated[
        str | None,
        typer.Argument(
            help="name of a query, or sql for a query of your own; default: list the queries", show_default=False
        ),
    ] = None,
    query: Annotated[
        str | None, typer.Argument(help="after sql: a statement SELECT ... FROM hours", show_default=False)
    ] = None,
    folder: Annotated[Path, typer.Option(help="folder to which `fleet collect` writes")] = DEFAULT_FOLDER,
    days: Annotated[
        int | None,
        typer.Option(min=1, help="use only this number of most recent days; default: all days", show_default=False),
    ] = None,
    within: Annotated[
        float,
        typer.Option(min=0.0, help="query failing: list packs that will reach a limit within this number of days"),
    ] = 90.0,
    json: Annotated[bool, typer.Option("--json", help="print the result as a JSON list of objects")] = False,
    csv: Annotated[bool, typer.Option("--csv", help="print the result as CSV")] = False,
) -> None:
    """Query the hourly summaries of all packs. Without a name, list the queries."""
    from bms_estimator.fleet.queries import duckdb_queries  # noqa: PLC0415 - its packages are optional

    if name is None:
        _list_queries(duckdb_queries.QUERIES)
        return
    if (query is not None) != (name == "sql"):
        raise UserError("give an SQL query after sql, and only there: fleet ask sql 'SELECT count(*) FROM hours'")
    if json and csv:
        raise UserError("--json and --csv: choose one")
    if query is not None:
        answer = duckdb_queries.select(folder, query, days=days)
    else:
        limits = duckdb_queries.Limits(within_days=within)
        answer = duckdb_queries.run_query(folder, name, days=days, limits=limits)
    for note in answer.notes:
        typer.echo(f"note: {note}", err=True)
    (_print_json if json else _print_csv if csv else _print_table)(answer)


def _list_queries(queries: "dict[str, Query]") -> None:
    for name, query in queries.items():
        typer.echo(f"{name:16}{query.help}")
    typer.echo(f"{'sql':16}any SELECT from the view hours; fleet ask sql 'DESCRIBE hours' lists its columns")


def _print_json(answer: "Answer") -> None:
    typer.echo(dumps(answer.records, indent=1, allow_nan=False, default=str))


def _print_csv(answer: "Answer") -> None:
    table = writer(sys.stdout, lineterminator="\n")
    table.writerow(answer.columns)
    table.writerows(answer.rows)


def _print_table(answer: "Answer") -> None:
    print_table(answer.columns, answer.rows)
    if not answer.rows:
        typer.echo("none")
