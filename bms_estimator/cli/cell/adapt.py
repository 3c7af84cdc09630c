"""``bms-estimator adapt``: cell file by the thesis's steps 2 (RC pairs, a1..a12) and 3 (R_s, a13..a15) from captures."""

import json
import math
import sys
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from bms_estimator.calibration.thesis.adapt import Adaptation, adapt
from bms_estimator.cli.options.capture_input import load_captures
from bms_estimator.cli.options.capture_options import (
    AsJson,
    CapacityAh,
    CapturesFromRest,
    CellName,
    Force,
    InitialSoc,
    MappedColumns,
    NewCellFile,
    SignOfCurrent,
    check_output_file,
    reject_duplicates,
    write_cell_named_as_file,
)
from bms_estimator.model.cell import load_cell
from bms_estimator.telemetry.state import finite


def adapt_command(
    captures: CapturesFromRest,
    cell: CellName,
    out: NewCellFile,
    capacity_ah: CapacityAh = None,
    soc: InitialSoc = None,
    current_sign: SignOfCurrent = None,
    column_map: MappedColumns = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Estimate a cell's RC pairs and series resistance by the thesis's adaptive observer, and write a cell file.

    The thesis is "Adaptive Estimation of Li-ion Battery Model Parameters".
    Its adaptive observer (Algorithm 1) runs over the capture with the smallest mean current.
    The averages of this run, by equation (3.19), are a1..a12: coefficients of both RC pairs as functions of SOC.
    Equation (4.2) computes the series resistance R_s from all captures; a13..a15 are its coefficients.

    Run `ocv` first, and give its cell file, which contains the OCV, as --cell.
    Both cell files get a score from replays of the captures: it contains the SOC error and the width of the SOC interval
    (docs/cell/identify.md).
    The new file is written only if its score is at most 5 % above the score of --cell.
    """
    check_output_file(out, captures, force=force)
    reject_duplicates(captures)
    model = load_cell(cell, capacity_ah)
    loaded = load_captures(captures, current_sign=current_sign, column_map=column_map)
    adaptation = adapt(loaded, model, soc=soc)
    write_cell_named_as_file(out, adaptation.cell, _remarks(cell, adaptation), loaded)
    if as_json:
        sys.stdout.write(json.dumps(_json_result(out, adaptation)) + "\n")
        return
    console = Console()
    console.print(
        f"{out}: written", _a_table(adaptation), _capture_table(adaptation), *_remarks(cell, adaptation)[1:], sep="\n"
    )


def _json_result(out: Path, adaptation: Adaptation) -> dict[str, Any]:
    std = [None] * 12 + [finite(x) for x in adaptation.steps.r_s.std]  # a1..a12 have no standard error
    a = adaptation.steps.a[1:].tolist()
    return {
        "out": str(out),
        "a": {f"a{i}": {"value": value, "std": std[i - 1]} for i, value in enumerate(a, start=1)},
        "algorithm_1": adaptation.steps.run.outcome,
        "t_int_s": adaptation.steps.run.window.t_int_s,
        "t_unst_s": adaptation.steps.run.window.t_unst_s,
        "r_s_rms_mohm": 1e3 * adaptation.steps.r_s.rms_ohm,
        "error_mv": 1e3 * _voltage_error_v(adaptation),
        "captures": [
            {
                "name": c.name,
                "initial_soc": c.initial_soc,
                "voltage_rms_mv_soc_above_0_1": 1e3 * c.voltage_rms_v,
                "score_before_percent": finite(c.score_before),
                "score_after_percent": finite(c.score_after),
                "held_back": c.held_back,
            }
            for c in adaptation.captures
        ],
        "score_before_percent": finite(adaptation.score_before),
        "score_after_percent": finite(adaptation.score_after),
    }


def _voltage_error_v(adaptation: Adaptation) -> float:
    return math.nan if adaptation.cell.ladder is None else adaptation.cell.ladder.error_v


def _remarks(cell: str, adaptation: Adaptation) -> list[str]:
    """Return the comments at the beginning of the cell file."""
    run, std = adaptation.steps.run, adaptation.steps.r_s.std
    names = ", ".join(c.name for c in adaptation.captures)
    return [
        f"a1..a15 by the thesis's steps 2 and 3 from {names};",
        f"capacity and open-circuit voltage from {Path(cell).name}. Algorithm 1: {run.outcome}.",
        "a1..a12 have no standard error: the adaptation law (3.18) leads them to the weighted mean of their bounds.",
        f"Standard errors of a13, a14, a15: {std[0]:.2g} ohm, {std[1]:.2g}, {std[2]:.2g} ohm (nan: at a bound).",
        f"Error of the voltage above SOC 0.1: {1e3 * _voltage_error_v(adaptation):.1f} mV RMS.",
        f"Interval score of replays started in mid-load: {adaptation.score_before:.2f} % before, {adaptation.score_after:.2f} % after.",
    ]


def _a_table(adaptation: Adaptation) -> Table:
    """Return a1..a15 as a table with a row for each element."""
    table = Table("element", "amplitude", "exponent", "offset", box=box.SIMPLE_HEAD)
    for name, first in (("R_ts", 1), ("R_tl", 4), ("C_ts", 7), ("C_tl", 10), ("R_s", 13)):  # index of the amplitude
        table.add_row(f"{name}: a{first}..a{first + 2}", *(f"{x:.4g}" for x in adaptation.steps.a[first : first + 3]))
    return table


def _capture_table(adaptation: Adaptation) -> Table:
    table = Table("capture", "SOC", "RMS", "before", "after", "held back", box=box.SIMPLE_HEAD)
    for c in adaptation.captures:
        scores = (f"{x:.2f} %" if math.isfinite(x) else "-" for x in (c.score_before, c.score_after))
        table.add_row(
            c.name, f"{c.initial_soc:.3f}", f"{1e3 * c.voltage_rms_v:.1f} mV", *scores, "yes" if c.held_back else "no"
        )
    return table
