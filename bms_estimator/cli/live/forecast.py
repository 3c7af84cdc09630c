"""``bms-estimator forecast``: time to cut-off under a load that the user gives."""

import json
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer
from rich import box
from rich.console import Console
from rich.table import Table

from bms_estimator.checkpoint.state_files import SavedPack, StateFiles
from bms_estimator.cli.options.capture_input import capture_file, long_file_bar, print_guesses
from bms_estimator.cli.options.capture_options import (
    CAPTURE_FORMATS,
    CELL_HELP,
    AsJson,
    CapacityAh,
    Force,
    MappedColumns,
    SignOfCurrent,
    check_output_file,
    complete_battery,
)
from bms_estimator.cli.options.pack_options import decimal, pack_or_cell, with_pack
from bms_estimator.cli.options.progress_bar import compile_ahead
from bms_estimator.forecast.available_power import Forecast, ForecastCurve
from bms_estimator.forecast.trip import MAX_LOAD, MAX_TRIP_S, Trip, TripOutcome, constant_trip, trip_outcome
from bms_estimator.model.cell_slots import CellSlots
from bms_estimator.model.errors import UserError
from bms_estimator.model.pack_model import PackModel
from bms_estimator.pack.pack import new_pack
from bms_estimator.process.state_folder import state_folder
from bms_estimator.reports.report_parts import duration_text, number
from bms_estimator.service.request_handlers import as_json_data
from bms_estimator.settings.pack import Settings
from bms_estimator.sources.captures.curves import read_trip
from bms_estimator.sources.captures.replay import open_capture
from bms_estimator.telemetry.state import CUTOFF_FIELDS, cutoff_text

PLOT_FORMATS = (".png", ".svg", ".pdf")
"""Allowed extensions of the plot file."""


def forecast(
    pack: Annotated[
        Path | None,
        typer.Argument(help="settings file of the pack, pack.toml; optional with --capture", show_default=False),
    ] = None,
    load: Annotated[
        Path | None,
        typer.Option(
            help="table of the expected load with the columns time_s and current_a or power_w, or a capture with this load",
            show_default=False,
        ),
    ] = None,
    current_a: Annotated[
        float | None,
        typer.Option(
            parser=decimal(-MAX_LOAD, MAX_LOAD),
            help="expected constant current [A], positive on discharge",
            show_default=False,
        ),
    ] = None,
    power_w: Annotated[
        float | None,
        typer.Option(
            parser=decimal(-MAX_LOAD, MAX_LOAD),
            help="expected constant power [W], positive on discharge",
            show_default=False,
        ),
    ] = None,
    duration_s: Annotated[
        float | None,
        typer.Option(
            parser=decimal(1.0, MAX_TRIP_S),
            help="duration of the constant load in seconds; default: no end",
            show_default=False,
        ),
    ] = None,
    cutoff_v: Annotated[
        float | None,
        typer.Option(
            parser=decimal(),
            help="voltage of the pack at which the load is switched off [V]; default: pack.cutoff_v of the settings, "
            "otherwise pack.cutoff_voltage_v",
            show_default=False,
        ),
    ] = None,
    capture: Annotated[
        Path | None,
        typer.Option(help=f"capture at whose end the forecast starts: {CAPTURE_FORMATS}", show_default=False),
    ] = None,
    cell: Annotated[
        str | None,
        typer.Option(help=f"with --capture: {CELL_HELP}", autocompletion=complete_battery, show_default=False),
    ] = None,
    capacity_ah: CapacityAh = None,
    current_sign: SignOfCurrent = None,
    column_map: MappedColumns = None,
    plot: Annotated[
        Path | None,
        typer.Option(
            help=f"file for a plot of the predicted SOC and voltage: {', '.join(PLOT_FORMATS)}",
            show_default=False,
        ),
    ] = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Forecast the time to cut-off under an expected load, from the state of a pack or from the end of a capture.

    The state comes from the last checkpoint of the pack's service, which may be running.
    If no load is given, a load like the observed one is expected.
    """
    if pack is None and capture is None:
        raise UserError("give the settings file of a pack, or --capture FILE --cell NAME")
    if plot is not None:
        _check_plot_file(plot, [path for path in (pack, load, capture) if path], force=force)
    trip, load_text = _trip(load, current_a, power_w, duration_s)
    settings, model = pack_or_cell(pack, cell, capacity_ah)
    if cutoff_v is not None:
        settings = with_pack(settings, cutoff_v=cutoff_v)
    compile_ahead()
    if capture is not None:
        start = _end_of_capture(settings, model, capture, current_sign, column_map, has_pack=pack is not None)
    else:
        start = StateFiles(state_folder(settings), settings, model).saved_pack()
    if start.load_reason:
        typer.echo(f"warning: the observed load is unknown: {start.load_reason}", err=True)
    forecaster = start.pack.forecaster
    if forecaster is None:
        raise UserError(f"{model.cell.name}: a forecast needs a battery, and identifier.enabled = true in the settings")
    result = forecaster.forecast(trip.load if trip else None)
    curve = forecaster.given_load_curve(trip.load) if trip and trip.has_end else None
    outcome = trip_outcome(trip, curve) if trip and curve else None
    if plot is not None:
        _write_plot(plot, start.name, curve or result.curve, forecaster.cutoff_v)
    if as_json:
        sys.stdout.write(json.dumps(as_json_data(result, outcome, forecaster.cutoff_v)) + "\n")
    else:
        Console().print(_result_table(start, forecaster.cutoff_v, load_text, result, outcome))


def _end_of_capture(
    settings: Settings,
    model: PackModel,
    capture: Path,
    current_sign: SignOfCurrent,
    column_map: MappedColumns,
    *,
    has_pack: bool,
) -> SavedPack:
    """Return the pack at the end of a capture. The load of the capture is the observed load.

    Raises:
        UserError: The capture cannot be read or has no usable sample.
    """
    with capture_file(capture) as path:
        source = open_capture(
            path, settings.sensor if has_pack else None, current_sign=current_sign, column_map=column_map
        )
        print_guesses(path.name, source)
        pack = new_pack(settings, model, has_forecasts=False)
        slots = CellSlots(model.cell.series_count)
        with long_file_bar("reading", path) as progress:
            for samples in source:
                pack.run(samples, slots.select(source.cells))
                progress(source.fraction)
        if not pack.estimator.state["samples"][0]:
            raise UserError(f"{path}: no usable sample")
    return SavedPack(path.name, pack)


def _trip(
    load: Path | None, current_a: float | None, power_w: float | None, duration_s: float | None
) -> tuple[Trip | None, str]:
    """Return the trip that the options give, and its description; None: a load like the observed one.

    Raises:
        UserError: More than one load is given, or a load cannot be used.
    """
    given = {"--load": load, "--current-a": current_a, "--power-w": power_w}
    names = [name for name, value in given.items() if value is not None]
    if len(names) > 1:
        raise UserError(f"{' and '.join(names)}: give one of them")
    if duration_s is not None and (load is not None or not names):
        raise UserError("--duration-s: belongs to --current-a or --power-w")
    if load is not None:
        with capture_file(load) as path:
            trip, capture = read_trip(path)
            if capture:
                print_guesses(path.name, capture)
        return trip, f"{path.name}, {duration_text(float(trip.load.duration_s.sum()))}"
    end_text = f" for {duration_text(duration_s)}" if duration_s else ""
    if current_a is not None:
        return constant_trip("current_a", current_a, duration_s), f"{current_a:g} A{end_text}"
    if power_w is not None:
        return constant_trip("power_w", power_w, duration_s), f"{power_w:g} W{end_text}"
    return None, "like the observed load"


def _result_table(
    start: SavedPack, cutoff_v: float, load: str, forecast: Forecast, outcome: TripOutcome | None
) -> Table:
    table = Table(title=start.name, title_justify="left", show_header=False, box=box.SIMPLE_HEAD)
    table.add_column(style="dim")
    table.add_column()
    estimator = start.pack.estimator
    rows = {
        "SOC now": f"{estimator.soc:.1%} ± {2.0 * estimator.weakest_cell_soc_std:.1%}",
        **_age_row(start.age_s),
        "load": load,
        f"time to {cutoff_v:.4g} V": _time_text(forecast),
        **(dict(_trip_rows(outcome)) if outcome else {}),
    }
    for name, value in rows.items():
        table.add_row(name, value)
    return table


def _age_row(age_s: float | None) -> dict[str, str]:
    if age_s is None:
        return {}
    return {"saved": f"{duration_text(age_s)} ago" if math.isfinite(age_s) else "at an unknown time"}


def _time_text(forecast: Forecast) -> str:
    """Return the time to the cut-off, or the reason why it is unknown."""
    if forecast.reason is not None:
        return f"unknown: {forecast.reason}"
    return cutoff_text(*(float(forecast.values[0][name]) for name in CUTOFF_FIELDS)) or "unknown"


def _trip_rows(outcome: TripOutcome) -> Iterator[tuple[str, str]]:
    color = {"enough": "green", "uncertain": "yellow", "not enough": "red"}[outcome.verdict]
    yield "energy needed", f"{number(outcome.energy_wh)} Wh"
    yield "enough for the trip", f"[{color}]{outcome.verdict}[/], probability {outcome.enough_probability:.0%}"
    yield "SOC at the end", f"{outcome.soc_p50:.1%} ({outcome.soc_p05:.1%} to {outcome.soc_p95:.1%})"
    yield (
        "voltage at the end",
        f"{outcome.voltage_p50_v:.4g} V ({outcome.voltage_p05_v:.4g} V to {outcome.voltage_p95_v:.4g} V)",
    )


def _check_plot_file(plot: Path, inputs: list[Path], *, force: bool) -> None:
    if plot.suffix not in PLOT_FORMATS:
        raise UserError(f"--plot {plot}: must end in {', '.join(PLOT_FORMATS)}")
    check_output_file(plot, inputs, force=force, option="--plot")


def _write_plot(plot: Path, title: str, curve: ForecastCurve | None, cutoff_v: float) -> None:
    """Write a plot of the predicted SOC and voltage to a file.

    Raises:
        UserError: There is no curve, or the file cannot be written.
    """
    if curve is None:
        raise UserError(
            f"--plot {plot}: there is no forecast to plot; run the command without --plot to see the reason"
        )
    from matplotlib import pyplot as plt  # noqa: PLC0415 - optional

    from bms_estimator.plot.forecast import soc_ahead, voltage_ahead  # noqa: PLC0415 - optional
    from bms_estimator.plot.style import STYLE  # noqa: PLC0415 - optional

    with plt.rc_context(STYLE):
        figure, (upper, lower) = plt.subplots(2, 1, figsize=(7.0, 5.0), sharex=True)
        soc_ahead(curve, ax=upper)
        voltage_ahead(curve, cutoff_v, ax=lower)
        figure.suptitle(title)
        try:
            figure.savefig(plot)
        except OSError as error:
            raise UserError(f"--plot {plot}: cannot be written: {error.strerror}") from error
        finally:
            plt.close(figure)
