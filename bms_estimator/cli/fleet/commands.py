"""``bms-estimator fleet``: table of its commands."""

import typer

from bms_estimator.cli.lazy_group import LazyCommand, LazyGroup

COMMANDS = {
    "demo": LazyCommand(
        "bms_estimator.cli.fleet.demo:demo", "Run a server, simulated packs, workers and the page in one terminal."
    ),
    "serve": LazyCommand(
        "bms_estimator.cli.fleet.serve:serve", "Run a node of the fleet server, which stores samples and results."
    ),
    "user": LazyCommand(
        "bms_estimator.cli.fleet.serve:user", "Print the token with which the edge of a pack connects."
    ),
    "users": LazyCommand(
        "bms_estimator.cli.fleet.serve:users", "Write the tokens of the edges of all packs of a table."
    ),
    "worker": LazyCommand(
        "bms_estimator.cli.fleet.worker:worker", "Run a worker, which estimates a share of the packs."
    ),
    "fit": LazyCommand(
        "bms_estimator.cli.fleet.fit:fit", "Fit the models of packs to their histories, once a day for each pack."
    ),
    "ingest": LazyCommand(
        "bms_estimator.cli.fleet.ingest:ingest", "Receive batches of samples from a telemetry platform."
    ),
    "status": LazyCommand(
        "bms_estimator.cli.fleet.status:status",
        "List the workers, their versions and the partitions that they cannot read.",
    ),
    "dead-letters": LazyCommand(
        "bms_estimator.cli.fleet.dead_letters:app", "List or replay blocks that workers could not process."
    ),
    "checkpoints": LazyCommand(
        "bms_estimator.cli.fleet.checkpoints:app",
        "List the stored states of all packs, or return to those of an earlier day.",
    ),
    "backup": LazyCommand(
        "bms_estimator.cli.fleet.backup:backup", "Write a backup of a tenant's streams while they are in use."
    ),
    "restore": LazyCommand(
        "bms_estimator.cli.fleet.backup:restore", "Restore a tenant's streams from a backup on a new server."
    ),
    "packs": LazyCommand("bms_estimator.cli.fleet.packs:app", "Upload, list, show or remove the settings of packs."),
    "capture": LazyCommand(
        "bms_estimator.cli.fleet.capture:capture", "Write a pack's stored samples to a CSV or Parquet file."
    ),
    "collect": LazyCommand(
        "bms_estimator.cli.fleet.queries:collect", "Write hourly summaries of all packs to Parquet files."
    ),
    "ask": LazyCommand("bms_estimator.cli.fleet.queries:ask", "Query the hourly summaries of all packs."),
    "repair": LazyCommand(
        "bms_estimator.cli.fleet.queries:repair", "Repair rows that arrived while the clock of the server was wrong."
    ),
    "page": LazyCommand("bms_estimator.cli.fleet.page:page", "Serve a web page of all packs."),
    "simulate": LazyCommand(
        "bms_estimator.cli.fleet.simulate:simulate", "Simulate the edges of many packs, which send samples."
    ),
}


class _Commands(LazyGroup):
    entries = COMMANDS


app = typer.Typer(
    cls=_Commands,
    no_args_is_help=True,
    add_completion=False,
    help="Estimate many packs: at each pack an edge sends samples to a NATS server, and workers estimate.",
)


@app.callback()
def _group() -> None:
    """Make this app a group. Without this callback, typer would reject an app whose commands are added lazily."""
