"""``bms-estimator identify``: a cell's elements from captures, into a cell file."""

import json
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import typer
from rich import box
from rich.console import Console, Group
from rich.table import Table

from bms_estimator.calibration.identifiability import Verdict
from bms_estimator.calibration.identify import Identification, identify
from bms_estimator.cli.captures import (
    CELL_HELP,
    AsJson,
    CapacityAh,
    Force,
    NewCellFile,
    SignOfCurrent,
    check_out,
    name_of,
)
from bms_estimator.model.cell import load_cell
from bms_estimator.model.cell_file import write_cell
from bms_estimator.sources.replay import load_capture

UNITS = {"r": "ohm", "c": "F"}
COLOURS = {Verdict.IDENTIFIED: "green", Verdict.WEAK: "yellow", Verdict.NOT_TOLD: "red"}


def identify_command(
    captures: Annotated[
        list[Path], typer.Argument(help="recorded captures, CSV (.gz) or Parquet, each from rest", show_default=False)
    ],
    cell: Annotated[str, typer.Option(help=f"{CELL_HELP}; its capacity, OCV, start", show_default=False)],
    out: NewCellFile,
    capacity_ah: CapacityAh = None,
    keep_ocv: Annotated[bool, typer.Option(help="leave the open-circuit voltage as it is")] = False,
    current_sign: SignOfCurrent = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Identify a cell's elements from captures and write a cell file.

    Several captures are fitted jointly. Loads with steps and rests over the whole range of SOC tell most; what a load
    does not tell keeps about the value of --cell, and is named.
    """
    check_out(out, captures, force=force)
    model = load_cell(cell, capacity_ah)
    loaded = [load_capture(path, current_sign=current_sign) for path in captures]
    started_s = time.perf_counter()
    found = identify(loaded, model, refine_ocv=not keep_ocv)
    seconds = time.perf_counter() - started_s
    renamed = found.cell.model_copy(update={"cell": found.cell.cell.model_copy(update={"name": name_of(out)})})
    start = cell if capacity_ah is None else f"{cell} of {capacity_ah:g} Ah"
    write_cell(out, renamed, _remarks(start, found))
    if as_json:
        sys.stdout.write(json.dumps(_json(out, found, seconds)) + "\n")
    else:
        Console().print(_tables(out, found, seconds))


def _json(out: Path, found: Identification, seconds: float) -> dict[str, Any]:
    return {
        "out": str(out),
        "parameters": {
            p.name: {
                "value": p.value,
                "std": p.std,
                "relative_std": p.relative_std,
                "verdict": p.verdict.value,
                "at_limit": p.at_limit,
                "leans_on": p.leans_on,
                "correlation": p.correlation,
            }
            for p in found.parameters
        },
        "not_told": [p.name for p in found.parameters if p.verdict is Verdict.NOT_TOLD],
        "correlation": found.correlation.tolist(),
        "elements": [
            {"soc": soc}
            | {f"{name}_{_unit(name)}": value for name, (value, _) in row.items()}
            | {f"{name}_{_unit(name)}_std": std for name, (_, std) in row.items()}
            for soc, row in found.elements.items()
        ],
        "captures": [
            {
                "name": c.name,
                "samples": c.samples,
                "glitches": c.glitches,
                "steps": c.steps,
                "initial_soc": c.initial_soc,
                "initial_soc_std": c.initial_soc_std,
                "contact_ohm": c.contact_ohm,
                "voltage_rms_mv_soc_above_0_1": 1e3 * c.voltage_rms_v,
            }
            for c in found.captures
        ],
        "ocv_correction_rms_mv": 1e3 * found.ocv_correction_v,
        "iterations": found.iterations,
        "seconds": seconds,
    }


def _remarks(cell: str, found: Identification) -> list[str]:
    fitted = ", ".join(f"{c.name} ({1e3 * c.voltage_rms_v:.1f} mV RMS)" for c in found.captures)
    doubtful = ", ".join(p.name for p in found.parameters if p.verdict is Verdict.NOT_TOLD)
    lines = [
        f"Identified from {fitted}, SOC above 0.1;",
        f"capacity and the start of the search from {Path(cell).name}.",
    ]
    if found.ocv_correction_v:
        lines.append(f"OCV: that of {Path(cell).name}, corrected by {1e3 * found.ocv_correction_v:.1f} mV RMS.")
    return [*lines, f"Not told by this load: {doubtful}."] if doubtful else lines


def _tables(out: Path, found: Identification, seconds: float) -> Group:
    """The outcome for people."""
    numbers = Table(title=f"{out}: written", title_justify="left", box=box.SIMPLE_HEAD)
    for column in ("", "value", "std", "", "leans on"):
        numbers.add_column(column, justify="left" if not column or column == "leans on" else "right")
    for p in found.parameters:
        verdict = f"[{COLOURS[p.verdict]}]{p.verdict.value}[/]" + (", at its limit" if p.at_limit else "")
        numbers.add_row(p.name, f"{p.value:.5g}", f"{p.std:.2g}", verdict, f"{p.leans_on} ({p.correlation:+.2f})")
    shown = Table("SOC", *(f"{soc:g}" for soc in found.elements), box=box.SIMPLE_HEAD)
    for name in next(iter(found.elements.values())):
        cells = (found.elements[soc][name] for soc in found.elements)
        shown.add_row(f"{name} \\[{_unit(name)}]", *(f"{value:.4g} ± {std:.2g}" for value, std in cells))
    fits = Table(box=box.SIMPLE_HEAD)
    for column in ("capture", "RMS, SOC > 0.1", "initial SOC", "contacts", "glitches"):
        fits.add_column(column, justify="left" if column == "capture" else "right")
    for c in found.captures:
        fits.add_row(
            c.name.split(".")[0],
            f"{1e3 * c.voltage_rms_v:.2f} mV",
            f"{c.initial_soc:.4f} ± {c.initial_soc_std:.4f}",
            f"{1e3 * c.contact_ohm:+.2f} mohm",
            f"{c.glitches}",
        )
    ocv = f"OCV corrected by {1e3 * found.ocv_correction_v:.1f} mV RMS; " if found.ocv_correction_v else ""
    return Group(numbers, shown, fits, f"{ocv}{found.iterations} iterations in {seconds:.2f} s")


def _unit(element: str) -> str:
    return UNITS[element[0]]
