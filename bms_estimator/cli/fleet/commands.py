"""``bms-estimator fleet``: the table of its commands."""

import typer

from bms_estimator.cli.lazy_group import Entry, LazyGroup

COMMANDS = {
    "demo": Entry("bms_estimator.cli.fleet.demo:demo", "Server, simulated packs, workers and page in one terminal."),
    "serve": Entry("bms_estimator.cli.fleet.serve:serve", "Run a node of the server, with its streams."),
    "user": Entry("bms_estimator.cli.fleet.serve:user", "Print the token with which a tenant's pack connects."),
    "worker": Entry("bms_estimator.cli.fleet.worker:worker", "Estimate the packs of some partitions."),
    "packs": Entry("bms_estimator.cli.fleet.packs:app", "Which cells each pack has: load, list, show, remove."),
    "capture": Entry("bms_estimator.cli.fleet.capture:capture", "What a pack has sent, as a capture for replay."),
    "identify": Entry("bms_estimator.cli.fleet.identify:identify", "Identify packs anew from what they have sent."),
    "collect": Entry("bms_estimator.cli.fleet.queries:collect", "Write the summaries of hours to Parquet."),
    "ask": Entry("bms_estimator.cli.fleet.queries:ask", "Questions to the summaries of all packs."),
    "page": Entry("bms_estimator.cli.fleet.page:page", "The page of all packs."),
    "simulate": Entry("bms_estimator.cli.fleet.simulate:simulate", "Edges of many simulated packs."),
}


class _Commands(LazyGroup):
    entries = COMMANDS


app = typer.Typer(cls=_Commands, no_args_is_help=True, add_completion=False, help="Many packs on a NATS server.")


@app.callback()
def _group() -> None:
    """Keep it a group."""
