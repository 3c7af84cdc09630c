"""``bms-estimator replay``: estimates from a capture."""

import asyncio
import itertools
import json
import sys
import time
from collections.abc import Iterator
from contextlib import AsyncExitStack
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich import box
from rich.console import Console
from rich.table import Table

from bms_estimator.cli.captures.replay_summary import ReplayResult, Summary
from bms_estimator.cli.options.capture_input import capture_file, print_guesses
from bms_estimator.cli.options.capture_options import (
    CAPTURE_HELP,
    CELL_OR_FUEL_CELL_HELP,
    AsJson,
    CapacityAh,
    Force,
    MappedColumns,
    SignOfCurrent,
    SocOfEstimator,
    check_output_file,
    complete_cell,
)
from bms_estimator.cli.options.pack_options import (
    decimal,
    pack_or_cell,
    reject_soc_for_fuel_cell,
    with_broker,
    with_pack,
)
from bms_estimator.cli.options.progress_bar import compile_ahead, progress_bar
from bms_estimator.model.arrays import Records
from bms_estimator.model.cell_slots import CellSlots
from bms_estimator.model.clock import Clock
from bms_estimator.model.errors import UserError
from bms_estimator.model.pack_model import PackModel
from bms_estimator.mqtt.connection import DeliveryStats
from bms_estimator.pack.pack import Pack, RunResult, new_pack
from bms_estimator.service.kernel_warm_up import load_forecast_kernels
from bms_estimator.service.publisher import Publisher
from bms_estimator.service.service_status import ServiceStatus
from bms_estimator.settings.alarm_limits import short_limit_a
from bms_estimator.settings.pack import Settings
from bms_estimator.sinks.mqtt.requests import RequestDispatcher
from bms_estimator.sinks.mqtt.sink import MqttSink
from bms_estimator.sinks.trace_file import TableSink, join_columns, table_sink
from bms_estimator.sources.captures.replay import RawCapture, Replay, no_samples_error, open_capture
from bms_estimator.sources.source import ReceivedSamples
from bms_estimator.store.outbox import Outbox
from bms_estimator.telemetry.cells import cell_columns
from bms_estimator.telemetry.health import dropped_text, out_of_range_reason
from bms_estimator.telemetry.state import CUTOFF_FIELDS, cutoff_text

CELL_UPDATE_S = 10.0
"""Interval at which the columns of the cells are updated [s]. It equals the averaging window of the cell estimator."""
RARE_FAULT_FRACTION = 0.01
"""Maximum fraction of samples with a fault for which no likely cause is reported."""


def replay(
    capture: Annotated[Path, typer.Argument(help=CAPTURE_HELP, show_default=False)],
    cell: Annotated[
        str | None, typer.Option(help=CELL_OR_FUEL_CELL_HELP, autocompletion=complete_cell, show_default=False)
    ] = None,
    capacity_ah: CapacityAh = None,
    pack: Annotated[Path | None, typer.Option(help="settings file of the pack, pack.toml", show_default=False)] = None,
    soc: SocOfEstimator = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="file to which the estimates of each sample are written: .csv, .csv.gz or .parquet", show_default=False
        ),
    ] = None,
    cutoff_v: Annotated[
        float | None,
        typer.Option(
            parser=decimal(1e-3),
            help="voltage at which the load is switched off, which ends the forecast [V]; default: cut-off of the pack (pack.cutoff_v, otherwise pack.cutoff_voltage_v)",
            show_default=False,
        ),
    ] = None,
    force: Force = False,
    current_sign: SignOfCurrent = None,
    column_map: MappedColumns = None,
    as_json: AsJson = False,
    no_pack_model: Annotated[
        bool,
        typer.Option(
            "--no-pack-model", help="do not fit the pack's own curve, capacity and resistances to its history"
        ),
    ] = False,
    mqtt: Annotated[
        str | None, typer.Option(help="also publish the estimates to this MQTT broker, mqtt://host:port")
    ] = None,
    speed: Annotated[
        float | None,
        typer.Option(
            parser=decimal(1e-3), help="speed of the replay relative to the recorded time; default: as fast as possible"
        ),
    ] = None,
) -> None:
    """Run the live service's estimator over a capture.

    For a file of `run --record`, the estimates are bit-identical with those of the recorded run, if the run began without
    a checkpoint and each fit was finished in time (docs/pack/checkpoints.md).
    """
    settings, model = pack_or_cell(pack, cell, capacity_ah)
    if soc is not None:
        reject_soc_for_fuel_cell(model, "--soc")
        settings = with_pack(settings, initial_soc=soc)
    if cutoff_v is not None:
        reject_soc_for_fuel_cell(model, "--cutoff-v")
        settings = with_pack(settings, cutoff_v=cutoff_v)
    settings = with_broker(settings, mqtt) if mqtt else settings.model_copy(update={"mqtt": None})
    if out is not None:
        check_output_file(out, [capture], force=force)
    with capture_file(capture) as path:
        compile_ahead()
        source = open_capture(path, settings.sensor if pack else None, current_sign=current_sign, column_map=column_map)
        print_guesses(path.name, source)
        replay_source = Replay(source, speed=speed)
        table = table_sink(out) if out else None
        result = asyncio.run(_replay(settings, model, replay_source, table, fit_pack=not no_pack_model))
        if isinstance(source, RawCapture):
            for warning in _unread_warnings(source, result.duration_s or 0.0):
                typer.echo(f"warning: {capture}: {warning}", err=True)
        if replay_source.samples == 0:
            raise no_samples_error(path, source)
        if result.samples == 0:
            raise UserError(f"{path}: no usable sample; dropped: {_dropped_text(result)}")
    if as_json:
        sys.stdout.write(json.dumps(asdict(result)) + "\n")
    else:
        Console().print(result_table(path.name, result))
        if result.cells:
            Console().print(cells_table(result.cells))


def _unread_warnings(source: RawCapture, duration_s: float) -> Iterator[str]:
    if source.damaged:
        yield f"damaged after {duration_s:.1f} s; the rest was not read"
    if source.unread_bytes:
        yield f"the last {source.unread_bytes:,} bytes are no complete record: the file is truncated, or the length in a record is damaged"


async def _replay(
    settings: Settings, model: PackModel, source: Replay, table: TableSink | None, *, fit_pack: bool
) -> ReplayResult:
    """Run the estimator over a source, and pass the estimates to table, summary and broker."""
    errors: dict[str, str] = {}  # last error text of each kind of failed fit
    if not fit_pack:
        identifier = settings.identifier.model_copy(update={"pack_model": False})
        settings = settings.model_copy(update={"identifier": identifier})
    pack = new_pack(
        settings,
        model,
        on_failure=lambda error: errors.update({type(error).__name__: str(error)}),
        # forecasts at intervals take longer than the estimates, and the summary needs only the last one
        has_forecasts=bool(table or settings.mqtt),
    )
    if pack.forecaster:
        load_forecast_kernels()
    summary, slots = Summary(), CellSlots(model.cell.series_count)
    async with AsyncExitStack() as stack:
        publisher = await _open_publisher(stack, settings, pack, source)
        rows = _TableRows(stack.enter_context(table) if table else None, pack)
        bar = stack.enter_context(progress_bar("replaying"))
        started_s, impossible = time.perf_counter(), None
        async for each in source:
            received = each._replace(cells_v=slots.select(each.cells_v))
            for part in rows.parts(received):
                step = pack.run(part.samples, part.cells_v, part.device_soc)
                summary.add(step.trace)
                rows.add(step)
                if step.trace.size < part.samples.size:  # samples were dropped
                    impossible = out_of_range_reason(part.samples, pack.estimator.settings[0]) or impossible
                if publisher:
                    publisher.add(part, step, slots.fault)
                    await asyncio.sleep(0)  # the MQTT client runs in this event loop
            rows.write()
            bar.update(source.fraction)
        wall_s = time.perf_counter() - started_s
        if publisher:
            publisher.publish_last()
    for kind, text in errors.items():
        typer.echo(f"warning: a fit of the pack's model failed: {kind}: {text}", err=True)
    if slots.reason:
        typer.echo(f"warning: no estimates of single cells: {slots.reason}", err=True)
    result = summary.result(pack, short_limit_a(settings, model), source.samples, wall_s)
    return replace(result, impossible=impossible, temperatures_dropped=source.counters.get("implausible", 0))


class _TableRows:
    """Rows of a table: estimates, forecasts and, if the first block has cell voltages, columns of the cells.

    Args:
        table: The table; None: no rows are kept.
        pack: The pack.
    """

    def __init__(self, table: TableSink | None, pack: Pack) -> None:
        self._table, self._pack = table, pack
        self._has_cells: bool | None = None  # all rows of a table have the same columns
        self._rows = list[Records]()

    def parts(self, received: ReceivedSamples) -> Iterator[ReceivedSamples]:
        """Split a block into parts of ``CELL_UPDATE_S``, because the columns of the cells change after each part.

        Without these columns, yield the whole block.
        """
        if self._has_cells is None:
            has_rows = self._table is not None and self._pack.forecaster is not None
            self._has_cells = has_rows and received.cells_v.size > 0
        changes = np.diff(received.samples["time_s"] // CELL_UPDATE_S) if self._has_cells else np.zeros(0)
        edges = [0, *(np.flatnonzero(changes) + 1).tolist(), received.samples.size]
        for begin, end in itertools.pairwise(edges):
            part = slice(begin, end)
            yield ReceivedSamples(
                received.samples[part], received.cells_v[part], received.probes[part], received.device_soc[part]
            )

    def add(self, step: RunResult) -> None:
        """Append the rows of a part."""
        if self._table is None:
            return
        columns = [step.forecasts] if self._pack.forecaster else []
        if self._has_cells and self._pack.cells:
            columns.append(cell_columns(self._pack.cells.deviations, step.trace.size))
        self._rows.append(join_columns(step.trace, *columns))

    def write(self) -> None:
        """Write the appended rows to the table."""
        if self._table is not None:
            self._table.write(np.concatenate(self._rows))
            self._rows.clear()


async def _open_publisher(stack: AsyncExitStack, settings: Settings, pack: Pack, source: Replay) -> Publisher | None:
    """Return the publisher; None without a broker."""
    if settings.mqtt is None:
        return None
    delivery = DeliveryStats()
    outbox = Outbox(None, max_messages=settings.store.outbox_messages)
    home = settings.home_assistant
    mqtt = MqttSink(
        settings.mqtt, settings.pack.name, RequestDispatcher(delivery), delivery, outbox, home_assistant=home
    )
    sinks = [await stack.enter_async_context(mqtt)]
    return Publisher(settings, pack, source=source, sinks=sinks, clock=Clock(), status=ServiceStatus(delivery))


def result_table(title: str, result: ReplayResult) -> Table:
    """Return the result as a table."""
    table = Table(title=title, title_justify="left", show_header=False, box=box.SIMPLE_HEAD)
    table.add_column(style="dim")
    table.add_column(justify="right")
    lock_text = f"[red]lost {result.lock_losses} times[/]" if result.lock_lost else "[green]kept[/]"
    has_soc = result.soc_final is not None
    rows = {
        "samples": f"{result.samples:,}",
        "dropped": _dropped_text(result),
        **({"gaps": f"{result.gaps:,}"} if result.gaps else {}),
        **({"clock set back": _clock_steps_text(result)} if result.time_steps_back else {}),
        "duration": _number_text(result.duration_s, ",.1f", "s"),
        **(_soc_rows(result) if has_soc else {}),
        "innovation, RMS": _number_text(result.innovation_rms_v, ".3f", "mV", 1e3),
        "observer: tracking error, RMS": _number_text(result.tracking_error_rms_v, ".3f", "mV", 1e3),
        "observer: lock": lock_text,
        "observer: k at the end": _number_text(result.k_final, ".4g", "V²s"),
        "speed": f"{_number_text(result.samples_per_s, ',.0f')} samples/s, {result.wall_s:.2f} s",
    }
    parameter_rows = {
        name: f"{'' if p.valid else 'not valid: '}{_number_text(p.value, '.4g')} ± {_number_text(p.std, '.2g')}"
        for name, p in result.parameters.items()
        if not has_soc  # a1..a21 of a battery are in the JSON only
    }
    for name, value in (rows | parameter_rows).items():
        table.add_row(name, value)
    for suspicion in result.suspects:
        table.add_row("suspected", f"[yellow]{suspicion}[/]")
    return table


def cells_table(cells: list[dict[str, Any]]) -> Table:
    """Return the cells in series as a table, with the lowest SOC first."""
    table = Table(title="cells", title_justify="left", box=box.SIMPLE_HEAD)
    for header in ("cell", "SOC", "resistance", "capacity", "self-discharge", "fault"):
        table.add_column(header, justify="left" if header == "fault" else "right")
    for cell in sorted(cells, key=lambda each: each["soc"]):
        table.add_row(
            str(cell["number"]),
            f"{cell['soc']:.1%} ± {cell['soc_std']:.1%}",
            f"{cell['resistance_ratio']:.2f} ± {cell['resistance_ratio_std']:.2f}",
            f"{cell['capacity_ratio']:.3f}",
            f"{1e3 * cell['self_discharge_a']:.1f} ± {1e3 * cell['self_discharge_std_a']:.1f} mA",
            f"[red]{cell['fault']}[/]" if cell["fault"] else "",
        )
    return table


def _soc_rows(result: ReplayResult) -> dict[str, str]:
    return {
        "SOC": f"{_number_text(result.soc_initial, '.2%')} to {_number_text(result.soc_final, '.2%')}",
        "SOC, std at the end": _number_text(result.soc_std_final, ".2%"),
        **({} if result.capacity_ah is None else {"capacity": _capacity_text(result)}),
        **_forecast_row(result),
        **_temperature_row(result),
    }


def _forecast_row(result: ReplayResult) -> dict[str, str]:
    f = result.forecast
    if not f:
        return {}
    text = cutoff_text(*(f[name] for name in CUTOFF_FIELDS))
    return {"time to cut-off": text or f"unknown: {result.forecast_reason}"}


def _capacity_text(result: ReplayResult) -> str:
    """Return the learned capacity with its std and the number of fits that determined it."""
    text = f"{_number_text(result.capacity_ah, '.4g')} ± {_number_text(result.capacity_std_ah, '.2g')} Ah"
    failed = f", {result.failed_fits:,} failed" if result.failed_fits else ""
    return f"{text}, {result.fits:,} fits{failed}" if result.fits or failed else text


def _temperature_row(result: ReplayResult) -> dict[str, str]:
    dropped = f"{result.temperatures_dropped:,} implausible values"
    if not result.temperature_sensor:
        reason = dropped if result.temperatures_dropped else "not measured"
        return {"temperature": f"{reason}: SOC std is larger"}
    return {"temperature": dropped} if result.temperatures_dropped else {}


def _clock_steps_text(result: ReplayResult) -> str:
    """Return the number of backward steps of the clock, with the likely cause if there are many."""
    text = f"{result.time_steps_back:,} times"
    is_frequent = result.time_steps_back > RARE_FAULT_FRACTION * result.samples
    return f"{text}: are the rows in the order of time?" if is_frequent else text


def _dropped_text(result: ReplayResult) -> str:
    """Return the counts of dropped samples, with the likely cause if there are many."""
    text, count = dropped_text(result.dropped), sum(result.dropped.values())
    return (
        f"{text}; {result.impossible}" if result.impossible and count > RARE_FAULT_FRACTION * result.samples else text
    )


def _number_text(value: float | None, form: str, unit: str = "", scale: float = 1.0) -> str:
    return "-" if value is None else f"{value * scale:{form}} {unit}".rstrip()
