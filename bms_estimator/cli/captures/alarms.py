"""``bms-estimator alarms``: which alarms a capture would have raised, to try limits before they matter."""

import asyncio
import json
import logging
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import structlog
import typer
from rich import box
from rich.console import Console
from rich.table import Table

from bms_estimator.cli.options.capture_options import OR_FUEL_CELL_HELP, AsJson, CapacityAh, SignOfCurrent
from bms_estimator.cli.options.compile_progress import show_compile_progress
from bms_estimator.cli.options.number_options import decimal
from bms_estimator.cli.options.pack_options import pack_or_cell, reject_soc_for_fuel_cell, with_pack
from bms_estimator.estimator.estimator import new_estimator
from bms_estimator.model.clock import Clock
from bms_estimator.model.errors import UserError
from bms_estimator.model.fuel_cell import PackModel
from bms_estimator.service.alarm_monitor import AlarmMonitor
from bms_estimator.settings.pack import Settings
from bms_estimator.sources.captures.replay import Replay, open_capture
from bms_estimator.sources.captures.stdin import standard_input
from bms_estimator.telemetry.alarms import Change

STEP_S = 1.0
"""Interval at which the identifier's suspicions are read, on the capture's clock [s]."""


@dataclass
class Raised:
    """An alarm that was raised; times on the capture's clock [s]."""

    alarm: str
    severity: str
    raised_s: float
    ended_s: float | None
    """Time of its end; None: active at the end."""
    latched: bool
    """True if its cause has ended but it waits for acknowledgment."""
    value: float | None
    limit: float | None
    unit: str | None
    text: str


@dataclass
class Found:
    """Alarms raised by a capture, and alarms that it has no data for."""

    raised: list[Raised]
    quiet: Sequence[str]
    """Watched, and not raised."""
    unmeasured: Sequence[str]
    """Monitored alarms whose quantity the capture lacks."""


def alarms(
    capture: Annotated[
        Path, typer.Argument(help="recorded capture, CSV (.gz) or Parquet; -: from stdin", show_default=False)
    ],
    cell: Annotated[str | None, typer.Option(help=OR_FUEL_CELL_HELP, show_default=False)] = None,
    capacity_ah: CapacityAh = None,
    pack: Annotated[
        Path | None, typer.Option(help="settings of the pack with its limits, pack.toml", show_default=False)
    ] = None,
    soc: Annotated[
        float | None, typer.Option(parser=decimal(0.0, 1.0), help="initial SOC, 0..1; default: from the OCV")
    ] = None,
    current_sign: SignOfCurrent = None,
    as_json: AsJson = False,
) -> None:
    """List the alarms that a capture would have raised, with their times. No hooks are run.

    The checks are those of live operation.
    """
    settings, model = pack_or_cell(pack, cell, capacity_ah)
    if soc is not None:
        reject_soc_for_fuel_cell(model, "--soc")
        settings = with_pack(settings, initial_soc=soc)
    with _quiet(), standard_input() if str(capture) == "-" else nullcontext(capture) as path:
        with show_compile_progress():
            read = open_capture(path, settings.sensor if pack else None, current_sign=current_sign)
        source = Replay(read, longest_s=STEP_S)
        found = asyncio.run(_found(settings, model, source))
        if source.samples == 0:
            raise UserError(f"{path}: holds no sample")
    if as_json:
        sys.stdout.write(json.dumps(asdict(found)) + "\n")
    else:
        _show(path.name, found)


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence the log, because the command itself prints what the service would log."""
    before = structlog.get_config()
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))
    try:
        yield
    finally:
        structlog.configure(**before)


async def _found(settings: Settings, cell: PackModel, source: Replay) -> Found:
    now_s, changes = 0.0, list[Change]()
    with show_compile_progress():
        estimator = new_estimator(settings, cell)
    without_hooks = settings.alarms.model_copy(update={"hook": ()})
    settings = settings.model_copy(update={"alarms": without_hooks})
    clock = Clock(wall=lambda: now_s, monotonic=lambda: now_s)  # only the capture's matters
    watch = AlarmMonitor(settings, cell, estimator, source, clock, changes.append)
    async for block in source:
        now_s = max(now_s, float(block["time_s"][-1]))
        watch.add(block, estimator.run(block), now_s)
    watch.evaluate(now_s)
    shown = watch.alarms.report()
    raised, latched = _paired(changes), {alarm.name for alarm in shown if alarm.latched}
    for each in raised:
        each.latched = each.ended_s is None and each.alarm in latched
    known, names = {alarm.name for alarm in shown}, {each.alarm for each in raised}
    quiet = [name for name in watch.alarms.names() if name in known and name not in names]
    return Found(raised, quiet, [name for name in watch.alarms.names() if name not in known])


def _paired(changes: list[Change]) -> list[Raised]:
    """Each alarm with its end."""
    found: list[Raised] = []
    for at_s, alarm, turn in changes:
        if turn == "watched":
            continue
        if alarm.active:
            told = alarm.value, alarm.limit, alarm.unit, alarm.text
            found.append(Raised(alarm.name, alarm.severity, at_s, None, False, *told))
        else:
            next(each for each in reversed(found) if each.alarm == alarm.name).ended_s = at_s
    return found


def _show(title: str, found: Found) -> None:
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
    for column in ("raised", "ended", "alarm"):
        table.add_column(column, justify="left" if column == "alarm" else "right", no_wrap=True)
    table.add_column("")
    for each in found.raised:
        end = "latched" if each.latched else "active" if each.ended_s is None else f"{each.ended_s:,.1f} s"
        colour = "red" if each.severity == "critical" else "yellow"
        table.add_row(f"{each.raised_s:,.1f} s", end, f"[{colour}]{each.alarm}[/]", each.text)
    console = Console()
    if found.raised:
        console.print(table)
    else:
        console.print(f"{title}: no alarm")
    console.print(f"not raised: {', '.join(found.quiet) or '-'}")
    console.print(f"not measured here: {', '.join(found.unmeasured) or '-'}")
