"""``bms-estimator report``: HTML page on captures and their cell's model, or on a pack's history."""

import time
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from bms_estimator.calibration.verdict import Verdict
from bms_estimator.cli.captures.capture_results import capture_result
from bms_estimator.cli.captures.history_results import pack_history
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
from bms_estimator.cli.options.number_options import decimal
from bms_estimator.cli.options.pack_options import load_pack, pack_or_cell, with_pack
from bms_estimator.model.cell import CellModel
from bms_estimator.model.config_file import write_text
from bms_estimator.model.errors import UserError
from bms_estimator.model.sample import CurrentSign
from bms_estimator.reports.capture_report import capture_report
from bms_estimator.reports.history_report import history_report
from bms_estimator.reports.report_page import ReportPage
from bms_estimator.settings.pack import load_settings
from bms_estimator.sources.captures.replay import Capture, open_capture
from bms_estimator.sources.captures.tables.layout import ColumnMap


def report(
    captures: Annotated[
        list[Path] | None,
        typer.Argument(
            help=f"captures, each a {CAPTURE_FORMATS}; default: the stored history of --pack", show_default=False
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
        verdict: Verdict of the calibration that made the cell file; None: by the captures.
    """
    settings, model = pack_or_cell(pack, cell, capacity_ah, series)
    if not isinstance(model, CellModel):
        raise UserError(f"{model.cell.name} is a fuel cell: report needs a battery")
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
