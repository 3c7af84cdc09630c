"""MkDocs hook: reference pages for settings, commands and payloads, generated from the code."""

import importlib
import os
from collections.abc import Iterable, Iterator
from typing import Any

import typer
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from bms_estimator.cli.fleet.commands import COMMANDS as FLEET_COMMANDS
from bms_estimator.cli.main import COMMANDS
from bms_estimator.fleet.metrics import families as fleet_definitions
from bms_estimator.model.payloads.estimate import Estimate
from bms_estimator.model.payloads.health import Health, Payload
from bms_estimator.model.payloads.snapshot import Alarm, CellsReport, ForecastReport, Info, ParameterReport
from bms_estimator.reports.thesis.report import build
from bms_estimator.reports.thesis.report_items import Table, name as item_name
from bms_estimator.settings.pack import Settings
from bms_estimator.settings.settings_template import settings_file

PAYLOADS: dict[str, type[Payload]] = {
    "state": Estimate,
    "parameters": ParameterReport,
    "forecast": ForecastReport,
    "health": Health,
    "info": Info,
    "alarm": Alarm,
    "cells": CellsReport,
}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages to the site."""
    tables = ["# The thesis\n"] if "WITHOUT_THESIS" in os.environ else thesis_tables()  # half a minute
    pages = {
        "settings": settings(),
        "commands": commands(),
        "payloads": payloads(),
        "fleet-metrics": fleet_metrics(),
        "thesis-tables": tables,
    }
    for name, lines in pages.items():
        files.append(File.generated(config, f"reference/{name}.md", content="\n".join(lines) + "\n"))
    return files


def settings() -> Iterator[str]:
    """Yield the page of all settings, as ``config init`` writes them."""
    yield from (
        "# Settings",
        "",
        "`bms-estimator config init pack.toml` writes this file. [`bms-estimator new`](../start/new.md) sets the values of a pack in it.",
        "",
    )
    yield from ("```toml", settings_file(Settings), "```")


def payloads() -> Iterator[str]:
    """Yield the page of all payloads: a table of fields for each topic and each object in it."""
    yield from ("# Payloads", "", "Fields of the JSON payloads on [MQTT](mqtt.md).", "")
    for topic, model in PAYLOADS.items():
        yield f"## {topic}\n"
        schema = model.model_json_schema(mode="serialization")
        yield from fields(schema)
        for name, definition in schema.get("$defs", {}).items():
            yield f"**{name}**\n"
            yield from fields(definition)


def fields(schema: dict[str, Any]) -> Iterator[str]:
    """Yield a description and a table of the fields of a JSON schema."""
    yield f"{schema.get('description', '')}\n\n| field | meaning |\n|---|---|"
    for name, field in schema["properties"].items():
        yield row([f"`{name}`", field.get("description", "")])
    yield ""


def commands() -> Iterator[str]:
    """Yield the page of all commands with their arguments and options."""
    yield "# Commands\n\n`bms-estimator COMMAND -h` shows the same. `bms-estimator --install-completion` lets bash, zsh or fish "
    yield "complete commands, options, cells, ports and protocols.\n"
    yield from EXIT_CODES
    for prefix, entries in (("bms-estimator", COMMANDS), ("bms-estimator fleet", FLEET_COMMANDS)):
        for name, entry in entries.items():
            if (prefix, name) != ("bms-estimator", "fleet"):
                module, attribute = entry.target.split(":")
                yield from command(f"{prefix} {name}", getattr(importlib.import_module(module), attribute), entry.help)


EXIT_CODES = """\
| exit code | meaning |
|---|---|
| 0 | done, also after Ctrl-C or SIGTERM of a command that runs until it is ended |
| 1 | an internal error with a traceback, a full or broken disk, a closed output pipe, or a fault that `doctor` found |
| 2 | an error that you can correct; `error:` lines on stderr name it |
| 75 | a fault of the environment that may end without a change of yours, such as a folder or file that is not there yet, a damaged file with a password, token or certificate, or another process that serves the pack; repeat the command later. systemd restarts a service |
| 130 | interrupted before the end, or before it began |

Results are written to stdout, everything else to stderr. `--json` prints exactly one object.

""".splitlines()


def command(title: str, target: object, summary: str) -> Iterator[str]:
    """Yield the section of one command, and those of its subcommands."""
    app = target if isinstance(target, typer.Typer) else typer.Typer(add_completion=False)
    if app is not target:
        app.command(help=None if getattr(target, "__doc__", None) else summary)(target)  # type: ignore[type-var]
    top = typer.main.get_command(app)
    children = getattr(top, "commands", {})
    for name, each in (children or {"": top}).items():
        heading = f"{title} {name}".strip()
        usage = " ".join(each.collect_usage_pieces(each.make_context(heading, [], resilient_parsing=True)))
        yield f"## {heading.removeprefix('bms-estimator ')}\n\n    {heading} {usage}\n\n{each.help or summary}\n"
        options = [parameter for parameter in each.params if parameter.param_type_name == "option"]
        if options:
            yield "| option | meaning |\n|---|---|"
        for option in options:
            names = ", ".join(f"`{each}`" for each in (*option.opts, *option.secondary_opts))
            yield row([names, getattr(option, "help", "") or ""])
        yield ""


def fleet_metrics() -> Iterator[str]:
    """Yield the page of the metrics of a fleet, with their labels and the kinds of events."""
    yield "# Metrics of a fleet\n\n[Metrics](../fleet/operation.md#metrics-and-alerts) explains where Prometheus reads them.\n"
    for title, labels, metrics in (
        ("Node of the server", [], fleet_definitions.NODE),
        ("Tenant", ["tenant"], fleet_definitions.TENANT),
        ("Worker, since its start", ["tenant", "worker"], fleet_definitions.WORKER),
    ):
        yield f"## {title}\n\n| metric | labels | meaning |\n|---|---|---|"
        for each in metrics:
            yield row([f"`{each.name}`", ", ".join([*labels, *([each.label] if each.label else [])]), each.meaning])
        yield ""
    yield "## Events\n\nValues of the label `event`:\n\n| event | number of |\n|---|---|"
    yield from (row([f"`{name}`", meaning]) for name, meaning in fleet_definitions.EVENTS.items())


def thesis_tables() -> Iterator[str]:
    """Yield the page of the thesis's errata, tables and figures, as ``bms-estimator thesis`` computes them."""
    yield "# The thesis: errata, tables and figures\n"
    yield "`bms-estimator thesis` computes this page. [The thesis](../theory/thesis.md) explains the verdicts.\n"
    *items, errata = build().items
    if not isinstance(errata, Table):
        raise TypeError(errata)
    yield from ("## Errata\n", row(errata.columns), row(["---"] * len(errata.columns)))
    yield from (row(cells) for cells in errata.rows)
    yield from ("\n## Tables and figures\n", row(["item", "title", "verdict", "reason"]), row(["---"] * 4))
    for item in items:
        fit = f", {item.free} free parameters" if isinstance(item, Table) and item.free else ""
        yield row([item_name(item), item.title, item.verdict.value + fit, item.reason])


def row(cells: Iterable[object]) -> str:
    """Return one row of a Markdown table."""
    return f"| {' | '.join(' '.join(str(cell).split()).replace('|', chr(92) + '|') for cell in cells)} |"
