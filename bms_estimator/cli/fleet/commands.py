"""``bms-estimator fleet``: table of its commands."""

import typer

from bms_estimator.cli.lazy_group import Entry, LazyGroup

COMMANDS = {
    "demo": Entry(
        "bms_estimator.cli.fleet.demo:demo", "Run server, simulated packs, workers and page in one terminal."
    ),
    "serve": Entry("bms_estimator.cli.fleet.serve:serve", "Run a node of the server, with its streams."),
    "user": Entry("bms_estimator.cli.fleet.serve:user", "Print the token with which a pack's edge connects."),
    "worker": Entry("bms_estimator.cli.fleet.worker:worker", "Estimate packs; each worker takes a share of them."),
    "packs": Entry("bms_estimator.cli.fleet.packs:app", "Load, list, show or remove packs and their cells."),
    "capture": Entry("bms_estimator.cli.fleet.capture:capture", "Write a pack's stored samples to a table."),
    "identify": Entry("bms_estimator.cli.fleet.identify:identify", "Re-identify packs from their stored samples."),
    "collect": Entry("bms_estimator.cli.fleet.queries:collect", "Write hourly summaries to Parquet."),
    "ask": Entry("bms_estimator.cli.fleet.queries:ask", "Query the hourly summaries of all packs."),
    "page": Entry("bms_estimator.cli.fleet.page:page", "Serve the page of all packs."),
    "simulate": Entry("bms_estimator.cli.fleet.simulate:simulate", "Simulate the edges of many packs."),
}


class _Commands(LazyGroup):
    entries = COMMANDS


app = typer.Typer(cls=_Commands, no_args_is_help=True, add_completion=False, help="Many packs on a NATS server.")


@app.callback()
def _group() -> None:
    """Make this app a group. Without this callback, typer would reject an app whose commands are added lazily."""
