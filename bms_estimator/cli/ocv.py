"""``bms-estimator ocv``: open-circuit voltage from relaxation tests, into a cell file."""

import json
import sys
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich import box
from rich.console import Console
from rich.table import Table

from bms_estimator.calibration.ocv import NAMES, ChenMoraFit, fit_chen_mora
from bms_estimator.calibration.ocv_points import Points, max_v, pooled, rms_v
from bms_estimator.calibration.ocv_table import TableFit, fit_table
from bms_estimator.calibration.relaxation import RelaxationTest, relaxation_test, without_glitches
from bms_estimator.calibration.rest_elements import rest_elements
from bms_estimator.cli.captures import AsJson, Force, NewCellFile, SignOfCurrent, check_out, name_of
from bms_estimator.model.cell import Cell, CellModel
from bms_estimator.model.cell_file import write_cell
from bms_estimator.model.sample import SampleBlock
from bms_estimator.sources.replay import load_capture

CELL_VOLTAGE_V = 3.7
"""Of one Li-ion cell in the middle of its discharge: tells how many are in series [V]."""
LOWEST, HIGHEST = 0.55, 1.06
"""Limits of a good sample: of the median voltage, of the full one."""
CURRENT_MAX_C = 5.0
"""Limit of a good sample when the capture itself has no larger current [1/h]."""


TENTHS = np.linspace(0.0, 1.0, 11)


class Form(StrEnum):
    """What the open-circuit voltage is written as."""

    CHEN_MORA = "chen-mora"
    TABLE = "table"


@dataclass(frozen=True)
class OcvResult:
    """The outcome, as ``--json`` prints it."""

    form: str
    capacity_ah: float
    series_count: int
    points: int
    soc: list[float]
    ocv_v: list[float]  # extrapolated to infinite rest
    std_v: list[float]
    remaining_v: list[float]  # what was left to relax at the end of each rest
    rms_mv: float  # points less curve
    max_mv: float
    error_mv: list[float]  # standard deviation of the table at SOC 0, 0.1 ... 1; none for (2.10)
    parameters: dict[str, dict[str, float | None]]  # a16..a21: value, std (None at a bound); none for a table
    captures: dict[str, dict[str, float]]
    rejected: list[str]


def ocv(
    captures: Annotated[
        list[Path], typer.Argument(help="relaxation tests: recorded captures, CSV (.gz) or Parquet", show_default=False)
    ],
    capacity_ah: Annotated[
        float, typer.Option(min=1e-6, help="capacity SOC is counted against [Ah]", show_default=False)
    ],
    out: NewCellFile,
    form: Annotated[Form, typer.Option(help="a smooth table, or the polynomial (2.10)")] = Form.TABLE,
    soc: Annotated[float, typer.Option(min=0.0, max=1.0, help="at the first sample of each capture")] = 1.0,
    series: Annotated[
        int | None, typer.Option(min=1, help="cells in series; else by 3.7 V each", show_default=False)
    ] = None,
    current_sign: SignOfCurrent = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Find the open-circuit voltage in relaxation tests and write a cell file.

    A relaxation test discharges a full cell in steps with a rest after each (thesis 5.2.1). Several tests are fitted
    jointly. The file's elements are a first idea, one value each from the rests: `identify` makes them good.
    """
    check_out(out, captures, force=force)
    samples = [load_capture(path, current_sign=current_sign).rows for path in captures]
    good = [without_glitches(s, path.name) for s, path in zip(samples, captures, strict=True)]
    middle_v = float(np.median(np.concatenate([s["voltage_v"] for s in good])))
    count = series or max(round(middle_v / CELL_VOLTAGE_V), 1)
    tests = [
        relaxation_test(s, capacity_ah, initial_soc=soc, series_count=count, name=path.name)
        for s, path in zip(samples, captures, strict=True)
    ]
    points = pooled(tests)
    fit = fit_table(points) if form is Form.TABLE else fit_chen_mora(points)
    result = _result(form, capacity_ah, count, points, fit, tests)
    cell = _cell(name_of(out), capacity_ah, count, fit, tests[0], good)
    write_cell(out, cell, _remarks(captures, result))
    if as_json:
        sys.stdout.write(json.dumps(asdict(result)) + "\n")
    else:
        Console().print(_table(out, result, tests))


def _result(
    form: Form,
    capacity_ah: float,
    series_count: int,
    points: Points,
    fit: ChenMoraFit | TableFit,
    tests: list[RelaxationTest],
) -> OcvResult:
    order = np.argsort(np.concatenate([t.soc for t in tests]), kind="stable")
    remaining_v = np.concatenate([[rest.remaining_v for rest in t.rests] for t in tests])[order]
    parameters: dict[str, dict[str, float | None]] = {}
    if isinstance(fit, ChenMoraFit):
        for name, value, std in zip(NAMES, fit.a, fit.std, strict=True):
            parameters[name] = {"value": float(value), "std": float(std) if np.isfinite(std) else None}
    return OcvResult(
        form=form.value,
        capacity_ah=capacity_ah,
        series_count=series_count,
        points=points.soc.size,
        soc=points.soc.tolist(),
        ocv_v=points.ocv_v.tolist(),
        std_v=points.std_v.tolist(),
        remaining_v=remaining_v.tolist(),
        rms_mv=1e3 * rms_v(fit.residual_v),
        max_mv=1e3 * max_v(fit.residual_v),
        error_mv=(1e3 * fit.error_at(TENTHS)).tolist() if isinstance(fit, TableFit) else [],
        parameters=parameters,
        captures={t.name: {"rests": len(t.rests), "glitches": t.glitches, "soc_final": t.end_soc} for t in tests},
        rejected=[line for t in tests for line in t.rejected],
    )


def _cell(
    name: str,
    capacity_ah: float,
    series_count: int,
    fit: ChenMoraFit | TableFit,
    test: RelaxationTest,
    samples: list[SampleBlock],
) -> CellModel:
    """The cell with its open-circuit voltage, and limits of what a good sample is."""
    middle_v, full_v = (float(v) for v in fit(np.array([0.5, 1.0])))
    largest_a = max(float(np.max(np.abs(s["current_a"]))) for s in samples)
    cell = Cell(
        name=name,
        capacity_ah=capacity_ah,
        series_count=series_count,
        nominal_voltage_v=round(middle_v, 2),
        voltage_min_v=round(LOWEST * middle_v, 2),
        voltage_max_v=round(HIGHEST * full_v, 2),
        current_max_a=round(max(CURRENT_MAX_C * capacity_ah, 1.5 * largest_a), 3),
    )
    elements = rest_elements(samples[0], test, capacity_ah).sections
    ocv = fit.ocv if isinstance(fit, ChenMoraFit) else fit.table()
    return CellModel.model_validate({"cell": cell, "ocv": ocv, **elements})


def _remarks(captures: list[Path], result: OcvResult) -> list[str]:
    names = ", ".join(path.name for path in captures)
    return [
        f"OCV: {result.points} rests of {names}, extrapolated to infinite rest;",
        f"the {result.form} form lies {result.rms_mv:.2f} mV RMS off them, {result.max_mv:.2f} mV at most.",
        "Elements: one value each from the rests of the first capture, a start for identify.",
    ]


def _table(out: Path, result: OcvResult, tests: list[RelaxationTest]) -> Table:
    """The outcome for people."""
    table = Table(title=f"{out}: written", title_justify="left", show_header=False, box=box.SIMPLE_HEAD)
    table.add_column(style="dim")
    table.add_column(justify="right")
    left_mv = 1e3 * np.abs(result.remaining_v)
    std_mv = 1e3 * np.array(result.std_v)
    rows = {
        "points": f"{result.points}, SOC {result.soc[0]:.3f} to {result.soc[-1]:.3f}",
        "rests that gave none": f"{len(result.rejected)}",
        "glitches left out": f"{sum(test.glitches for test in tests)}",
        "left to relax at a rest's end": f"{np.median(left_mv):.2f} mV, at most {left_mv.max():.2f} mV",
        "std of a point": f"{np.median(std_mv):.2f} mV, at most {std_mv.max():.2f} mV",
        "points less curve": f"{result.rms_mv:.2f} mV RMS, at most {result.max_mv:.2f} mV",
        "cells in series": f"{result.series_count}",
    }
    if result.error_mv:
        rows["error of the curve at SOC 0, 0.1 ... 1"] = " ".join(f"{mv:.0f}" for mv in result.error_mv) + " mV"
    for name, parameter in result.parameters.items():
        std = parameter["std"]
        rows[name] = f"{parameter['value']:.5g} " + ("at its bound" if std is None else f"± {std:.2g}")
    for name, value in rows.items():
        table.add_row(name, value)
    return table
