"""Output of ``bms-estimator calibrate``: tables, JSON, and the comments in the cell file."""

import math
import textwrap
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Group
from rich.table import Table
from rich.text import Text

from bms_estimator.calibration.automatic.calibrate import Calibration
from bms_estimator.calibration.automatic.recognition import RecognizedCapture

REMARK_WIDTH = 110
"""Maximum length of a comment in the cell file [characters]."""


def remarks(calibration: Calibration) -> list[str]:
    """Return the comments at the beginning of the cell file."""
    captures = ", ".join(f"{each.capture.name} ({each.kind})" for each in calibration.captures)
    return [
        f"Calibrated from {captures}.",
        f"Capacity: {calibration.capacity.origin}.",
        *_origin_lines(calibration),
        *textwrap.wrap(f"{calibration.validation_data} {calibration.verdict.text}", REMARK_WIDTH),
    ]


def result_text(out: Path, calibration: Calibration) -> Group:
    """Return a table of the captures, with the results below it."""
    table = Table("capture", "recognized as", "°C", "used for", title=f"{out}: written", box=box.SIMPLE_HEAD)
    table.title_justify = "left"
    for each in calibration.captures:
        table.add_row(each.capture.name.split(".")[0], each.kind, _temperature_text(each), each.determined)
    lines = [f"capacity {calibration.model.cell.cell.capacity_ah:.4g} Ah: {calibration.capacity.origin}"]
    lines += [line.rstrip(".") for line in _origin_lines(calibration)]
    use = f'To use it, write cell = "{out}" in [pack] of the settings, without capacity_ah.'
    return Group(table, *lines, "", calibration.verdict.text, calibration.validation_data, "", Text(use))


def json_result(out: Path, calibration: Calibration) -> dict[str, Any]:
    """Return the object of ``--json``."""
    identification, verdict = calibration.model.identification, calibration.verdict
    return {
        "out": str(out),
        "capacity_ah": calibration.model.cell.cell.capacity_ah,
        "capacity_origin": calibration.capacity.origin,
        "captures": [
            {
                "name": each.capture.name,
                "kind": each.kind,
                "gives_ocv": each.gives_ocv,
                "gives_resistances": each.gives_resistances,
                "temperature_c": each.temperature_c if math.isfinite(each.temperature_c) else None,
            }
            for each in calibration.captures
        ],
        "ocv_measured": calibration.is_ocv_measured,
        "resistances_identified": identification is not None,
        "held_back": calibration.has_held_back_data,
        "validation": calibration.validation_data,
        "grade": verdict.grade,
        "verdict": verdict.text,
        "warnings": list(calibration.warnings),
    }


def _origin_lines(calibration: Calibration) -> list[str]:
    """Return sentences on the origin of the OCV curve and of the resistances."""
    model = calibration.model
    if model.ocv is None:
        ocv = "from the given cell, corrected by the fit"
    else:
        ocv = "measured" if calibration.is_ocv_measured else "estimated from rests of less than 2 minutes"
    if model.ocv is not None and model.ocv.sources.usual_hysteresis:
        ocv += f", with the hysteresis of the generic {model.ocv.generic.cell.name}"
    if model.identification is not None:
        return [f"OCV: {ocv}.", "Resistances: identified."]
    generic = model.ocv.generic.cell.name if model.ocv else model.cell.cell.name
    return [f"OCV: {ocv}.", f"Resistances: from the generic {generic}, because {model.reason}."]


def _temperature_text(each: RecognizedCapture) -> str:
    return f"{each.temperature_c:.0f}" if math.isfinite(each.temperature_c) else "no sensor"
