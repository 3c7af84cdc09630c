"""``bms-estimator alarms``: alarms that a capture would have raised, for choosing limits."""

import asyncio
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import typer
from rich import box
from rich.console import Console
from rich.table import Table

from bms_estimator.cli.options.capture_input import capture_file, print_guesses
from bms_estimator.cli.options.capture_options import (
    CAPTURE_HELP,
    CELL_OR_FUEL_CELL_HELP,
    AsJson,
    CapacityAh,
    MappedColumns,
    SignOfCurrent,
    SocOfEstimator,
    complete_cell,
)
from bms_estimator.cli.options.pack_options import pack_or_cell, reject_soc_for_fuel_cell, with_pack
from bms_estimator.cli.options.progress_bar import compile_ahead, progress_bar
from bms_estimator.cli.options.table import silenced_log
from bms_estimator.model.cell_slots import CellSlots
from bms_estimator.model.clock import Clock
from bms_estimator.model.pack_model import PackModel
from bms_estimator.pack.pack import new_pack
from bms_estimator.service.alarm_monitor import AlarmMonitor
from bms_estimator.service.kernel_warm_up import load_forecast_kernels
from bms_estimator.settings.pack import Settings
from bms_estimator.sources.captures.replay import Replay, no_samples_error, open_capture
from bms_estimator.telemetry.alarms.definitions import Change

MAX_BLOCK_S = 1.0
"""Maximum duration of a block [s]. Alarms are evaluated after each block, by the capture's clock."""


@dataclass
class RaisedAlarm:
    """Alarm that was raised, with times on the capture's clock [s]."""

    alarm: str
    severity: str
    raised_s: float
    ended_s: float | None
    """Time of its end; None if it is active at the end of the capture."""
    latched: bool
    """True if it is active only because it was not acknowledged."""
    value: float | None
    limit: float | None
    unit: str | None
    text: str


@dataclass
class AlarmResult:
    """Alarms of a capture: raised, not raised, and not monitored because of missing values."""

    raised: list[RaisedAlarm]
    quiet: Sequence[str]
    """Monitored alarms that were not raised."""
    unmeasured: Sequence[str]
    """Alarms without a value at the end, because the capture lacks a quantity or the load for a forecast, or the SOC is not known."""


def alarms(
    capture: Annotated[Path, typer.Argument(help=CAPTURE_HELP, show_default=False)],
    cell: Annotated[
        str | None, typer.Option(help=CELL_OR_FUEL_CELL_HELP, autocompletion=complete_cell, show_default=False)
    ] = None,
    capacity_ah: CapacityAh = None,
    pack: Annotated[
        Path | None,
        typer.Option(help="settings file of the pack, pack.toml, with the limits of the alarms", show_default=False),
    ] = None,
    soc: SocOfEstimator = None,
    current_sign: SignOfCurrent = None,
    column_map: MappedColumns = None,
    as_json: AsJson = False,
) -> None:
    """List the alarms that a capture would have raised, with their times.

    The alarms are evaluated as in the live service, but no hooks are run.
    """
    settings, model = pack_or_cell(pack, cell, capacity_ah)
    if soc is not None:
        reject_soc_for_fuel_cell(model, "--soc")
        settings = with_pack(settings, initial_soc=soc)
    with silenced_log(), capture_file(capture) as path:
        compile_ahead()
        opened = open_capture(path, settings.sensor if pack else None, current_sign=current_sign, column_map=column_map)
        print_guesses(path.name, opened)
        source = Replay(opened, max_block_s=MAX_BLOCK_S)
        result = asyncio.run(_evaluate(settings, model, source))
        if source.samples == 0:
            raise no_samples_error(path, opened)
    if as_json:
        sys.stdout.write(json.dumps(asdict(result)) + "\n")
    else:
        _print(path.name, result)


async def _evaluate(settings: Settings, model: PackModel, source: Replay) -> AlarmResult:
    """Run estimator and alarms over a capture."""
    now_s, changes = 0.0, list[Change]()
    pack = new_pack(settings, model)
    load_forecast_kernels()
    without_hooks = settings.alarms.model_copy(update={"hook": ()})
    settings = settings.model_copy(update={"alarms": without_hooks})
    clock = Clock(wall=lambda: now_s, monotonic=lambda: now_s)  # the capture's clock
    slots, monitor = CellSlots(model.cell.series_count), AlarmMonitor(settings, pack, source, clock, changes.append)
    with progress_bar("replaying") as bar:
        async for each in source:
            received = each._replace(cells_v=slots.select(each.cells_v))
            now_s = max(now_s, float(received.samples["time_s"][-1]))
            monitor.add(received, pack.run(received.samples, received.cells_v, received.device_soc), now_s, slots.fault)
            bar.update(source.fraction)
    if slots.reason:
        typer.echo(f"warning: no estimates of single cells: {slots.reason}", err=True)
    monitor.evaluate(now_s)
    raised_alarms = _pair_changes(changes)
    latched = {alarm.name for alarm in monitor.report if alarm.latched}
    for alarm in raised_alarms:
        alarm.latched = alarm.ended_s is None and alarm.alarm in latched
    raised, evaluated = {each.alarm for each in raised_alarms}, {a.name for a in monitor.report if not a.unknown_reason}
    not_raised = [name for name in monitor.alarms.names() if name not in raised]
    quiet = [name for name in not_raised if name in evaluated]
    return AlarmResult(raised_alarms, quiet, unmeasured=[name for name in not_raised if name not in evaluated])


def _pair_changes(changes: list[Change]) -> list[RaisedAlarm]:
    """Return the raised alarms, each with the time of its end, from the changes of all alarms."""
    raised_alarms: list[RaisedAlarm] = []
    for at_s, alarm, changed_field in changes:
        if changed_field == "watched":  # the alarm could no longer be evaluated, or could be again
            continue
        if alarm.active:
            raised_alarms.append(
                RaisedAlarm(
                    alarm.name,
                    alarm.severity,
                    raised_s=at_s,
                    ended_s=None,
                    latched=False,
                    value=alarm.value,
                    limit=alarm.limit,
                    unit=alarm.unit,
                    text=alarm.text,
                )
            )
        else:
            next(raised for raised in reversed(raised_alarms) if raised.alarm == alarm.name).ended_s = at_s
    return raised_alarms


def _print(title: str, result: AlarmResult) -> None:
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
    for column in ("raised", "ended", "alarm"):
        table.add_column(column, justify="left" if column == "alarm" else "right", no_wrap=True)
    table.add_column("")
    for alarm in result.raised:
        end = "latched" if alarm.latched else "active" if alarm.ended_s is None else f"{alarm.ended_s:,.1f} s"
        color = "red" if alarm.severity == "critical" else "yellow"
        table.add_row(f"{alarm.raised_s:,.1f} s", end, f"[{color}]{alarm.alarm}[/]", alarm.text)
    console = Console()
    if result.raised:
        console.print(table)
    else:
        console.print(f"{title}: no alarm")
    console.print(f"not raised: {', '.join(result.quiet) or '-'}")
    console.print(
        f"not monitored, because the capture lacks the quantity or the load for a forecast, or the SOC is not known: {', '.join(result.unmeasured) or '-'}"
    )
