"""``bms-estimator report``: HTML page on captures and their cell's model, or on the stored history of a pack."""

import time
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from bms_estimator.calibration.verdict import Verdict
from bms_estimator.checkpoint.arrays_file import RejectedFileError
from bms_estimator.checkpoint.state_files import StateFiles
from bms_estimator.cli.captures.capture_results import capture_result
from bms_estimator.cli.options.capture_input import capture_files, print_guesses
from bms_estimator.cli.options.capture_options import (
    CAPTURE_FORMATS,
    CELL_HELP,
    CapacityAh,
    Force,
    MappedColumns,
    Series,
    SignOfCurrent,
    TemperatureWithoutSensor,
    check_output_file,
    reject_duplicates,
    unique_names,
)
from bms_estimator.cli.options.pack_options import decimal, load_pack, pack_or_cell, with_pack
from bms_estimator.estimator.estimator import compiled_estimator
from bms_estimator.estimator.identified_parameters import present_elements, relative_capacity
from bms_estimator.model.arrays import CurrentSign, Floats
from bms_estimator.model.cell import CellModel
from bms_estimator.model.config_file import write_text
from bms_estimator.model.errors import UserError
from bms_estimator.model.pack_model import PackModel
from bms_estimator.pack_model.aging_course import aging_course
from bms_estimator.pack_model.cell_curves import CellCurves
from bms_estimator.pack_model.saved import history_from_arrays
from bms_estimator.process.state_folder import state_folder
from bms_estimator.reports.aging_group import AgingHistory
from bms_estimator.reports.capture_report import capture_report
from bms_estimator.reports.history_report import StoredHistory, history_report
from bms_estimator.reports.report_parts import ReportPage, number
from bms_estimator.settings.pack import Settings, load_settings
from bms_estimator.sources.captures.replay import Capture, open_capture
from bms_estimator.sources.captures.tables.layout import ColumnMap
from bms_estimator.store.history import MINUTE_S, Minute
from bms_estimator.store.history_reader import HistoryReader

CAPACITY = "capacity [Ah]"
"""Name of the learned capacity."""


def pack_history(settings: Settings, model: PackModel, folder: Path | None, since_s: float) -> StoredHistory:
    """Return the history that the service of a pack has stored.

    Args:
        settings: Settings of the pack.
        model: Model of the whole pack.
        folder: State folder of the service; None: the folder in the settings.
        since_s: Start time [s since 1970].

    Raises:
        UserError: The history cannot be read, or has no rows.
    """
    path = (folder or state_folder(settings)) / f"{settings.pack.name}.sqlite"
    file, until_s = HistoryReader(path), time.time() + MINUTE_S
    rows = file.rows(since_s, until_s, MINUTE_S)
    if not rows:
        raise UserError(f"{path}: no rows in this period; the service stores one for each minute")
    table = np.array(rows, dtype=np.float64)  # None becomes NaN
    columns = dict(zip(Minute._fields, table.T, strict=True))
    files, learned = StateFiles(path.parent, settings, model), list[tuple[str, str, str]]()
    not_learned = ""
    try:
        learned = _learned_parameters(files, model)
    except UserError as error:
        not_learned = str(error)
    events = file.events(since_s, until_s)
    aging = model.by_kind(
        lambda cell: _aging_history(files, settings, cell),
        lambda _: AgingHistory(None, "Only batteries have a capacity and resistances over days."),
    )
    if aging.course:
        learned = [row for row in learned if row[0] != CAPACITY]  # the table of the slow fit has the capacity
    warnings = _implausible_voltages(model, columns["voltage_v"], path)
    return StoredHistory(settings.pack.name, columns["time_s"], columns, events, learned, not_learned, aging, warnings)


def _implausible_voltages(model: PackModel, voltage_v: Floats, path: Path) -> list[str]:
    """Return a warning if a history has voltages that the pack cannot have, as from another pack of its name."""
    cell = model.cell
    low_v = model.min_voltage_ratio * cell.nominal_voltage_v
    outside_v = voltage_v[(voltage_v < low_v) | (voltage_v > cell.voltage_max_v)]
    if outside_v.size == 0:
        return []
    text = (
        f"{outside_v.size:,} of {voltage_v.size:,} minutes have voltages from {outside_v.min():.2f} to {outside_v.max():.2f} V, "
        f"outside {low_v:.2f} to {cell.voltage_max_v:.2f} V, the range of {cell.series_count} cells in series. The sensor was "
        f"wrong, or {path} also has the history of an earlier pack of this name; to begin a new history, stop the service and "
        "rename the file."
    )
    return [text]


def _aging_history(files: StateFiles, settings: Settings, model: CellModel) -> AgingHistory:
    """Return capacity and resistances over the days of the history to which the service fits the pack's model."""
    file = files.history
    try:
        arrays = file.load()
        rows, fit = history_from_arrays(arrays) if arrays else (None, None)
        if rows is None or fit is None:
            return AgingHistory(
                None,
                f"{file.path}: no fit yet; the service first fits capacity and resistances after half an hour of use.",
            )
        cell = CellCurves(compiled_estimator(settings, model).cell_file_settings)
        return AgingHistory(aging_course(cell, rows.rows, fit))
    except (RejectedFileError, OSError, ValueError) as error:
        return AgingHistory(None, f"{file.path} cannot be used: {error}.")


def _learned_parameters(files: StateFiles, model: PackModel) -> list[tuple[str, str, str]]:
    """Return name, value and std of the learned capacity and circuit elements.

    Raises:
        UserError: There is no valid checkpoint, or the pack is a fuel cell.
    """
    cell = model.battery("a fuel cell has no capacity and no elements over SOC")
    estimator = files.saved_pack().pack.estimator
    record, rated_ah = estimator.record[0], cell.capacity_ah
    capacity = relative_capacity(record)
    rows = [(CAPACITY, number(capacity.value * rated_ah), number(capacity.std * rated_ah, 2))]
    for name, element in present_elements(record).items():
        symbol, _, unit = name.rpartition("_")
        scale, label = (1e3, "mΩ") if unit == "ohm" else (1.0, "F")
        rows.append((f"{symbol.capitalize()} [{label}]", number(scale * element.value), number(scale * element.std, 2)))
    return rows


def report(
    captures: Annotated[
        list[Path] | None,
        typer.Argument(
            help=f"captures, each {CAPTURE_FORMATS}; default: the stored history of --pack", show_default=False
        ),
    ] = None,
    cell: Annotated[str | None, typer.Option(help=CELL_HELP, show_default=False)] = None,
    capacity_ah: CapacityAh = None,
    pack: Annotated[Path | None, typer.Option(help="settings file of the pack, pack.toml", show_default=False)] = None,
    out: Annotated[Path, typer.Option(help="HTML file to write")] = Path("report.html"),
    soc: Annotated[
        float | None,
        typer.Option(
            parser=decimal(0.0, 1.0),
            help="SOC at the first sample of each capture; default: from the voltage",
            show_default=False,
        ),
    ] = None,
    series: Series = None,
    temperature_c: TemperatureWithoutSensor = None,
    current_sign: SignOfCurrent = None,
    column_map: MappedColumns = None,
    days: Annotated[
        float | None,
        typer.Option(parser=decimal(0.01), help="days of history before now; default: the whole history"),
    ] = None,
    folder: Annotated[
        Path | None,
        typer.Option(
            help="state folder of the service; default: the folder in the settings of --pack", show_default=False
        ),
    ] = None,
    force: Force = False,
) -> None:
    """Write a report with figures, tables and a verdict in plain words, as one HTML file.

    With captures, the report compares them with the model of a cell, and shows SOC, circuit elements and data quality.
    Without captures, it shows the history that the service of --pack has stored.
    """
    started_s = time.perf_counter()
    check_output_file(out, [*(captures or ()), *([pack] if pack else ())], force=force)
    if captures:
        reject_duplicates(captures)
        with capture_files(captures) as files:
            opened = open_captures(files, pack, current_sign, column_map)
            for file, capture in zip(files, opened, strict=True):
                print_guesses(file.name, capture)
            page = report_on_captures(
                files, opened, pack, cell, capacity_ah, soc, series=series, temperature_c=temperature_c
            )
    else:
        page = _report_on_history(pack, folder, days)
    write_text(out, page.html())
    for sentence in page.sentences:
        typer.echo(sentence)
    typer.echo(f"{out}: written in {time.perf_counter() - started_s:.1f} s")


def open_captures(
    files: Sequence[Path], pack: Path | None, current_sign: CurrentSign | None, column_map: ColumnMap | None
) -> list[Capture]:
    """Open the captures of a report, and decode raw captures by the settings of the pack if it is given."""
    sensor = load_settings(pack).sensor if pack else None
    return [open_capture(file, sensor, current_sign=current_sign, column_map=column_map) for file in files]


def report_on_captures(
    files: Sequence[Path],
    opened: Sequence[Capture],
    pack: Path | None,
    cell: str | None,
    capacity_ah: float | None,
    soc: float | None,
    *,
    series: int | None,
    temperature_c: float | None,
    verdict: Verdict | None = None,
) -> ReportPage:
    """Return the page on captures and their cell's model.

    Args:
        files: Files of the captures.
        opened: The captures, at their beginning.
        pack: Settings file of the pack; None: default settings.
        cell: Cell; None: the pack's cell.
        capacity_ah: Capacity [Ah]; None: the capacity in the settings of the pack or in the cell file.
        soc: SOC at the first sample of each capture, 0..1; None: from the voltage.
        series: Number of cells in series; None: the number in the settings.
        temperature_c: Temperature of captures without a sensor [°C]; None: the default of the model.
        verdict: Verdict of the calibration that made the cell file; None: judge by the captures.
    """
    settings, pack_model = pack_or_cell(pack, cell, capacity_ah, series)
    model = pack_model.battery(f"{pack_model.cell.name} is a fuel cell: report needs a battery")
    if soc is not None:
        settings = with_pack(settings, initial_soc=soc)
    names = unique_names([file.name for file in files], files)
    results = [
        capture_result(file, name, capture, settings, model, initial_soc=soc, temperature_c=temperature_c)
        for file, name, capture in zip(files, names, opened, strict=True)
    ]
    return capture_report(model, results, _now(), verdict)


def _report_on_history(pack: Path | None, folder: Path | None, days: float | None) -> ReportPage:
    if pack is None:
        raise UserError("give captures with --cell NAME|CELL.toml, or --pack pack.toml for a report on its history")
    settings, model = load_pack(pack)
    since_s = 0.0 if days is None else time.time() - 86_400.0 * days
    return history_report(pack_history(settings, model, folder, since_s), _now())


def _now() -> str:
    return datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
