"""``bms-estimator identify``: cell file with resistances from captures."""

import json
import math
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import typer
from rich import box
from rich.console import Console, Group
from rich.table import Table

from bms_estimator.calibration.elements.identify import CaptureFit, Identification, identify
from bms_estimator.cli.cell.identify_fuel_cell import identify_fuel_cell
from bms_estimator.cli.options.capture_input import load_captures
from bms_estimator.cli.options.capture_options import (
    CELL_OR_FUEL_CELL_HELP,
    AsJson,
    CapacityAh,
    CapturesFromRest,
    Force,
    InitialSoc,
    MappedColumns,
    NewCellFile,
    SignOfCurrent,
    TemperatureWithoutSensor,
    check_output_file,
    complete_cell,
    reject_duplicates,
    write_cell_named_as_file,
)
from bms_estimator.cli.options.progress_bar import progress_bar
from bms_estimator.model.cell import is_fuel_cell, load_cell
from bms_estimator.model.errors import UserError
from bms_estimator.telemetry.state import finite


def identify_command(
    captures: CapturesFromRest,
    cell: Annotated[
        str,
        typer.Option(
            help=f"cell that supplies capacity and OCV: {CELL_OR_FUEL_CELL_HELP}",
            autocompletion=complete_cell,
            show_default=False,
        ),
    ],
    out: NewCellFile,
    capacity_ah: CapacityAh = None,
    soc: InitialSoc = None,
    temperature_c: TemperatureWithoutSensor = None,
    keep_ocv: Annotated[
        bool, typer.Option(help="keep the OCV of --cell unchanged; default: correct the OCV", show_default=False)
    ] = False,
    current_sign: SignOfCurrent = None,
    column_map: MappedColumns = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Identify a cell's resistances from captures, and write a cell file.

    Captures at several temperatures are fitted jointly. Loads with steps and rests over the whole SOC range are best.

    Run `ocv` first, and give its cell file, which contains the OCV, as --cell.
    Both cell files get a score from replays of the captures: it contains the SOC error and the width of the SOC interval
    (docs/cell/identify.md).
    The new file is written only if its score is at most 5 % above the score of --cell.

    For a fuel cell, give polarization curves (columns current_a, voltage_v) and captures under load
    (docs/theory/fuel-cell.md).
    """
    check_output_file(out, captures, force=force)
    reject_duplicates(captures)
    if is_fuel_cell(cell):
        if capacity_ah is not None or soc is not None or keep_ocv:
            raise UserError(f"{cell} is a fuel cell: --capacity-ah, --soc and --keep-ocv apply only to batteries")
        identify_fuel_cell(
            captures,
            cell,
            out,
            temperature_c=temperature_c,
            current_sign=current_sign,
            column_map=column_map,
            as_json=as_json,
        )
        return
    model = load_cell(cell, capacity_ah)
    loaded = load_captures(captures, current_sign=current_sign, column_map=column_map)
    started_s = time.perf_counter()
    with progress_bar("identifying") as bar:
        identification = identify(
            loaded,
            model,
            refine_ocv=not keep_ocv,
            initial_soc=soc,
            temperature_c=temperature_c,
            progress=bar.update,
        )
    duration_s = time.perf_counter() - started_s
    for line in identification.undetermined_starts:
        typer.echo(f"warning: {line}", err=True)
    initial_cell = cell if capacity_ah is None else f"{cell} of {capacity_ah:g} Ah"
    write_cell_named_as_file(out, identification.cell, _remarks(initial_cell, identification), loaded)
    if as_json:
        sys.stdout.write(json.dumps(_json_result(out, identification, duration_s)) + "\n")
    else:
        Console().print(_tables(out, identification, duration_s))


def _json_result(out: Path, identification: Identification, duration_s: float) -> dict[str, Any]:
    return {
        "out": str(out),
        "elements": [
            {"soc": soc}
            | {f"{name}_ohm": value for name, (value, _) in row.items()}
            | {f"{name}_ohm_std": std for name, (_, std) in row.items()}
            for soc, row in identification.elements.items()
        ],
        "temperature_c": _temperature_range_c(identification),
        "error_mv": 1e3 * _voltage_error_v(identification),
        "captures": [
            {
                "name": c.name,
                "samples": c.samples,
                "glitches": c.glitches,
                "initial_soc": c.initial_soc,
                "temperature_c": c.temperature_c,
                "miscount_percent": 100.0 * c.miscount,
                "voltage_rms_mv_soc_above_0_1": 1e3 * c.voltage_rms_v,
                "score_before_percent": finite(c.score_before),
                "score_after_percent": finite(c.score_after),
                "held_back": c.held_back,
            }
            for c in identification.captures
        ],
        "left_out": list(identification.left_out),
        "undetermined_starts": list(identification.undetermined_starts),
        "ocv_correction_rms_mv": 1e3 * identification.ocv_correction_v,
        "score_before_percent": finite(identification.score_before),
        "score_after_percent": finite(identification.score_after),
        "seconds": duration_s,
    }


def _temperature_range_c(identification: Identification) -> tuple[float, float]:
    """Return the lowest and the highest temperature of the cell [°C]; NaN for a model without an RC ladder."""
    ladder = identification.cell.ladder
    return (math.nan, math.nan) if ladder is None else ladder.temperature_c


def _voltage_error_v(identification: Identification) -> float:
    return math.nan if identification.cell.ladder is None else identification.cell.ladder.error_v


def _remarks(initial_cell: str, identification: Identification) -> list[str]:
    """Return the comments at the beginning of the cell file."""
    fitted = ", ".join(f"{c.name} ({1e3 * c.voltage_rms_v:.1f} mV RMS)" for c in identification.captures)
    low_c, high_c = _temperature_range_c(identification)
    lines = [
        f"Resistances identified from {fitted}, SOC above 0.1;",
        f"capacity and open-circuit voltage from {Path(initial_cell).name}. Cell temperatures {low_c:g} to {high_c:g} C.",
    ]
    if identification.ocv_correction_v:
        lines.append(
            f"OCV: that of {Path(initial_cell).name}, corrected by {1e3 * identification.ocv_correction_v:.1f} mV RMS."
        )
    return [*lines, f"{_score_text(identification)}."]


def _score_text(identification: Identification) -> str:
    if not math.isfinite(identification.score_after):
        return "No capture is long enough for replays that start in mid-load"
    held_back_count = sum(c.held_back for c in identification.captures)
    return (
        f"Replays that start in mid-load with an SOC error of 0.2: interval score {identification.score_before:.2f} % before, "
        f"{identification.score_after:.2f} % after; {held_back_count} of {len(identification.captures)} captures held back from the fit that they judge"
    )


def _tables(out: Path, identification: Identification, duration_s: float) -> Group:
    """Return a table of the resistances and a table of the captures, with the results for all captures below."""
    elements = Table(
        "SOC", *(f"{soc:g}" for soc in identification.elements), title=f"{out}: written", box=box.SIMPLE_HEAD
    )
    elements.title_justify = "left"
    for name in next(iter(identification.elements.values())):
        values = (identification.elements[soc][name] for soc in identification.elements)
        elements.add_row(f"{name} \\[mohm], 25 °C", *(f"{1e3 * value:.4g} ± {1e3 * std:.2g}" for value, std in values))
    captures = Table(box=box.SIMPLE_HEAD)
    for column in ("capture", "°C", "SOC", "count", "RMS", "before", "after", "held back"):
        captures.add_column(column, justify="left" if column in ("capture", "held back") else "right")
    for fit in identification.captures:
        captures.add_row(*_capture_row(fit))
    low_c, high_c = _temperature_range_c(identification)
    lines = [
        f"cell temperatures {low_c:g} to {high_c:g} °C; outside this range, the estimates have larger standard deviations",
        _score_text(identification),
    ]
    if identification.ocv_correction_v:
        lines.append(f"OCV corrected by {1e3 * identification.ocv_correction_v:.1f} mV RMS")
    if identification.left_out:
        lines.append(f"skipped, because the current is too small for resistances: {', '.join(identification.left_out)}")
    return Group(elements, captures, *lines, f"{duration_s:.1f} s")


def _capture_row(c: CaptureFit) -> tuple[str, ...]:
    temperature = "no sensor" if c.temperature_c is None else f"{c.temperature_c[0]:.0f} to {c.temperature_c[1]:.0f}"
    scores = (f"{x:.2f} %" if math.isfinite(x) else "-" for x in (c.score_before, c.score_after))
    name, rms = c.name.split(".")[0], f"{1e3 * c.voltage_rms_v:.1f} mV"
    miscount = f"{100.0 * c.miscount:+.1f} %"
    return name, temperature, f"{c.initial_soc:.3f}", miscount, rms, *scores, "yes" if c.held_back else "no"
