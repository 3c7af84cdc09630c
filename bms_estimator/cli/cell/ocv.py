"""``bms-estimator ocv``: open-circuit voltage from rests, slow curves and given curves, into a cell file."""

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from rich import box
from rich.console import Console
from rich.table import Table

from bms_estimator.calibration.cleaning.rests import remove_glitches
from bms_estimator.calibration.elements.generic_prior import curve, nearest_generic_cell, scaled_generic_ladder
from bms_estimator.calibration.elements.initial_elements import initial_elements
from bms_estimator.calibration.ocv.chen_mora_fit import NAMES, ChenMoraFit, fit_chen_mora
from bms_estimator.calibration.ocv.points import Points, max_v, rms_v
from bms_estimator.calibration.ocv.relaxation_test import RelaxationTest
from bms_estimator.calibration.ocv.sources import (
    ExternalCurve,
    OcvSources,
    Recording,
    center_on_typical_hysteresis,
    find_sources,
    has_plateau,
    without_branches,
)
from bms_estimator.calibration.ocv.table_fit import NODES, TableFit, fit_table
from bms_estimator.cli.options.capture_options import (
    AsJson,
    Force,
    NewCellFile,
    SignOfCurrent,
    check_once,
    check_out,
    name_of,
    unlike,
)
from bms_estimator.cli.options.number_options import decimal, whole
from bms_estimator.kernels.cell_model.rc_ladder import REFERENCE_C
from bms_estimator.model.cell import ELEMENTS, Cell, CellModel, Ladder
from bms_estimator.model.cell_file import write_cell
from bms_estimator.model.errors import UserError
from bms_estimator.sources.captures.curves import read_curve
from bms_estimator.sources.captures.replay import load_capture

CELL_VOLTAGE_V = 3.7
"""Voltage of one Li-ion cell in the middle of its discharge [V], which gives the number of cells in series."""
LOWEST_CELL_V, HIGHEST_CELL_V, MAX_CELLS = 1.5, 4.5, 300
"""Range of that voltage for any cell [V], and maximum number of cells in series."""
LOWEST, HIGHEST = 0.55, 1.06
"""Limits of a good sample: of the median voltage, of the full one."""
MIN_EMPTY = 0.25
"""An empty cell has at least this part of the voltage of a half full one."""
MEASURED_CAPACITY_STD = 0.03
"""Relative std of a capacity measured by a slow discharge: gain of the current sensor, other cells of the kind, some
years."""
CURRENT_MAX_C = 5.0
"""Limit of a good sample when the capture itself has no larger current [1/h]."""


STEEP = 0.05
"""SOC from the ends within which curves are steep."""
TENTHS = np.linspace(0.0, 1.0, 11)


class Form(StrEnum):
    """Form in which the open-circuit voltage is written."""

    CHEN_MORA = "chen-mora"
    TABLE = "table"


@dataclass(frozen=True)
class SourceResult:
    """Kind of a source and quality of its fit, as printed by ``--json``."""

    name: str
    kind: str
    points: int
    temperature_c: float | None
    off_mv: float | None  # RMS of what the source is off as a whole; None for (2.10)
    hysteresis_mv: float | None  # mean over SOC
    notes: list[str]


@dataclass(frozen=True)
class OcvResult:
    """The outcome, as ``--json`` prints it."""

    form: str
    capacity_ah: float
    capacity_measured_ah: float | None  # by a slow discharge from full to empty
    generic: str  # the most similar generic cell supplies what the sources do not: resistances ...
    usual_hysteresis: bool  # ... and hysteresis
    series_count: int
    points: int
    soc: list[float]
    ocv_v: list[float]  # of rests extrapolated to infinite time
    std_v: list[float]
    rms_mv: float  # points less curve
    max_mv: float
    rms_inside_mv: float  # at SOC 0.05 to 0.95, away from the steep ends
    error_mv: list[float]  # standard deviation of the table at SOC 0, 0.1 ... 1; none for (2.10)
    parameters: dict[str, dict[str, float | None]]  # a16..a21: value, std (None at a bound); none for a table
    sources: list[SourceResult]
    captures: dict[str, dict[str, float]]  # those with rests
    remaining_v: list[float]  # remaining relaxation at the end of each rest
    rejected: list[str]


def ocv(
    captures: Annotated[
        list[Path],
        typer.Argument(
            help="captures (CSV, .gz, Parquet): relaxation tests or HPPC, slow discharges and charges; or curves (CSV)",
            show_default=False,
        ),
    ],
    out: NewCellFile,
    capacity_ah: Annotated[
        float | None,
        typer.Option(
            parser=decimal(1e-6),
            help="capacity for counting the SOC [Ah]; default: measured by a slow discharge",
            show_default=False,
        ),
    ] = None,
    form: Annotated[Form, typer.Option(help="smooth table, or the polynomial (2.10)")] = Form.TABLE,
    soc: Annotated[
        float, typer.Option(parser=decimal(0.0, 1.0), help="SOC at the first sample of the fullest captures")
    ] = 1.0,
    series: Annotated[
        int | None,
        typer.Option(parser=whole(1), help="number of cells in series; default: from 3.7 V a cell", show_default=False),
    ] = None,
    current_sign: SignOfCurrent = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Determine the open-circuit voltage and write a cell file.

    Sources are captures with rests (relaxation tests, thesis 5.2.1, or HPPC), slow discharges and charges, and curves with
    columns soc, ocv_v[, hysteresis_v], at any temperatures. The kind of each file is recognized. The file's resistances are
    estimates from the rests and the most similar generic cell; `identify` improves them.
    """
    check_out(out, captures, force=force)
    check_once(captures)
    recordings, curves = [], []
    for name, path in zip(unlike([path.name for path in captures], captures), captures, strict=True):
        columns = read_curve(path)
        if columns is None:
            recordings.append(Recording(name, load_capture(path, current_sign=current_sign).rows))
        else:
            curves.append(ExternalCurve(name, *columns))
    good = [_moving(one) for one in recordings]
    count = _cells_in_series(np.concatenate([*good, *(curve.ocv_v for curve in curves)]), series)
    found = find_sources(recordings, curves, capacity_ah=capacity_ah, initial_soc=soc, series_count=count)
    fitted: Callable[[Points], ChenMoraFit | TableFit] = fit_table if form is Form.TABLE else fit_chen_mora
    curve_v = fitted(found.points)(NODES)
    generic = nearest_generic_cell(NODES, curve_v, found.capacity_ah, count)
    ladder, elements = _elements(generic, found, recordings)
    found = without_branches(found, ladder)
    if form is Form.TABLE and found.hysteresis_v is None and has_plateau(NODES, curve_v, count):
        found = center_on_typical_hysteresis(found, np.interp(NODES, *curve(generic, "hysteresis_v")))
    fit = fitted(found.points)
    _check_ends(fit, found)
    result = _result(form, generic, fit, found)
    cell = _cell(name_of(out), count, fit, found, recordings)
    write_cell(out, CellModel.model_validate({**cell, "ladder": ladder, **elements}), _remarks(result))
    if as_json:
        sys.stdout.write(json.dumps(asdict(result)) + "\n")
    else:
        console = Console()
        console.print(_table(out, result, found))
        console.print(_sources_table(result))


def _moving(one: Recording) -> NDArray[np.float64]:
    """Return the voltage without glitches [V].

    Raises:
        UserError: It is always the same.
    """
    voltage_v = remove_glitches(one.samples, one.name)["voltage_v"]
    if np.ptp(voltage_v) == 0.0:
        raise UserError(f"{one.name}: the voltage is {voltage_v[0]:g} V throughout: is the sensor connected?")
    return voltage_v


def _cells_in_series(voltage_v: NDArray[np.float64], told: int | None) -> int:
    """Return the configured value, else one by the usual voltage of a cell.

    Raises:
        UserError: No cell has what each of them would have.
    """
    middle_v = float(np.median(voltage_v))
    count = told or max(round(middle_v / CELL_VOLTAGE_V), 1)
    if not told and count > MAX_CELLS:
        raise UserError(
            f"the voltage is {middle_v:g} V, that of {count} cells in series: are these millivolts? else give --series"
        )
    if not LOWEST_CELL_V <= middle_v / count <= HIGHEST_CELL_V:
        raise UserError(f"--series {count}: {middle_v:g} V would be {middle_v / count:.2f} V per cell")
    return count


def _check_ends(fit: ChenMoraFit | TableFit, found: OcvSources) -> None:
    """Check that the curve does not fall to 0 V beyond its points.

    Raises:
        UserError: It does.
    """
    lowest_v, middle_v = (float(v) for v in fit(np.array([0.0, 0.5])))
    if lowest_v > MIN_EMPTY * middle_v:
        return
    raise UserError(
        f"the points begin at SOC {found.points.soc[0]:.2f}, and their curve would be {lowest_v:.2f} V at SOC 0: give captures "
        f"down to empty, or the right capacity; {found.capacity_ah:g} Ah is too much if the cell was emptied [--capacity-ah]"
    )


def _result(form: Form, generic: CellModel, fit: ChenMoraFit | TableFit, found: OcvSources) -> OcvResult:
    tests, points = found.tests, found.points
    parameters: dict[str, dict[str, float | None]] = {}
    if isinstance(fit, ChenMoraFit):
        for name, value, std in zip(NAMES, fit.a, fit.std, strict=True):
            parameters[name] = {"value": float(value), "std": float(std) if np.isfinite(std) else None}
    return OcvResult(
        form=form.value,
        capacity_ah=found.capacity_ah,
        capacity_measured_ah=_or_none(found.measured_ah),
        generic=generic.cell.name,
        usual_hysteresis=found.usual_hysteresis,
        series_count=generic.cell.series_count,
        points=points.soc.size,
        soc=points.soc.tolist(),
        ocv_v=points.ocv_v.tolist(),
        std_v=points.std_v.tolist(),
        rms_mv=1e3 * rms_v(fit.residual_v),
        max_mv=1e3 * max_v(fit.residual_v),
        rms_inside_mv=1e3 * rms_v(fit.residual_v[(points.soc > STEEP) & (points.soc < 1.0 - STEEP)]),
        error_mv=(1e3 * fit.error_at(TENTHS)).tolist() if isinstance(fit, TableFit) else [],
        parameters=parameters,
        sources=_source_results(fit, found),
        captures={t.name: {"rests": len(t.rests), "glitches": t.glitches, "soc_final": t.end_soc} for t in tests},
        remaining_v=[rest.remaining_v for test in tests for rest in test.rests],
        rejected=[line for t in tests for line in t.rejected],
    )


def _source_results(fit: ChenMoraFit | TableFit, found: OcvSources) -> list[SourceResult]:
    return [
        SourceResult(
            name=source.name,
            kind=source.kind,
            points=source.points.soc.size,
            temperature_c=_or_none(source.temperature_c),
            off_mv=1e3 * float(fit.deviation_v[i]) if isinstance(fit, TableFit) else None,
            hysteresis_mv=None if source.hysteresis_v is None else 1e3 * float(source.hysteresis_v.mean()),
            notes=list(source.notes),
        )
        for i, source in enumerate(found.sources)
    ]


def _or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _elements(generic: CellModel, found: OcvSources, recordings: list[Recording]) -> tuple[Ladder, dict[str, object]]:
    """Resistances over SOC, and a1..a15 by their sections: by the rests of one capture, else the generic cell's."""
    test = _warmest(found.tests)
    if test is None:
        return scaled_generic_ladder(generic, None), {element: getattr(generic, element) for element in ELEMENTS}
    rests = initial_elements(next(r.samples for r in recordings if r.name == test.name), test, found.capacity_ah)
    return scaled_generic_ladder(generic, rests, float(np.nan_to_num(test.temperature_c, nan=REFERENCE_C))), dict(
        rests.sections
    )


def _cell(
    name: str, series_count: int, fit: ChenMoraFit | TableFit, found: OcvSources, recordings: list[Recording]
) -> dict[str, object]:
    """Return the cell's section with limits of a good sample, and its OCV section."""
    middle_v, full_v = (float(v) for v in fit(np.array([0.5, 1.0])))
    lowest_v = float(fit(np.array([0.0]))[0])
    largest_a = max((float(np.nanmax(np.abs(one.samples["current_a"]))) for one in recordings), default=0.0)
    cell = Cell(
        name=name,
        capacity_ah=round(found.capacity_ah, 4),
        capacity_std=MEASURED_CAPACITY_STD if found.capacity_ah == found.measured_ah else None,
        series_count=series_count,
        nominal_voltage_v=round(middle_v, 2),
        voltage_min_v=round(min(LOWEST * middle_v, lowest_v), 2),
        voltage_max_v=round(HIGHEST * full_v, 2),
        current_max_a=round(max(CURRENT_MAX_C * found.capacity_ah, 1.5 * largest_a), 3),
    )
    ocv = fit.ocv if isinstance(fit, ChenMoraFit) else fit.table(found.hysteresis_v, found.hysteresis_std_v)
    return {"cell": cell, "ocv": ocv}


def _warmest(tests: Sequence[RelaxationTest]) -> RelaxationTest | None:
    """Return the test nearest to 25 C; the first test if none has a temperature."""
    away_k = [np.nan_to_num(abs(test.temperature_c - REFERENCE_C), nan=np.inf) for test in tests]
    return tests[int(np.argmin(away_k))] if tests else None


def _remarks(result: OcvResult) -> list[str]:
    like = f"the generic {result.generic}"
    hysteresis = [f"Hysteresis: that of {like}, no source tells it."] if result.usual_hysteresis else []
    elements = f"one value each from the rests of one capture, over SOC and temperature as those of {like}"
    return [
        f"OCV: {', '.join(f'{source.kind} of {source.name}' for source in result.sources)};",
        f"the {result.form} form lies {result.rms_mv:.2f} mV RMS off the points, {result.max_mv:.2f} mV at most.",
        *hysteresis,
        f"Elements: {elements if result.captures else f'those of {like}'}, a start for identify.",
    ]


def _table(out: Path, result: OcvResult, found: OcvSources) -> Table:
    """Return the result as a table."""
    table = Table(title=f"{out}: written", title_justify="left", show_header=False, box=box.SIMPLE_HEAD)
    table.add_column(style="dim")
    table.add_column(justify="right")
    std_mv = 1e3 * np.array(result.std_v)
    measured = result.capacity_measured_ah
    rows = {
        "points": f"{result.points}, SOC {result.soc[0]:.3f} to {result.soc[-1]:.3f}",
        "capacity": f"{result.capacity_ah:.4g} Ah"
        + ("" if measured is None else f", a slow discharge {measured:.4g} Ah"),
        "cells in series": f"{result.series_count}",
        "std of a point": f"{np.median(std_mv):.2f} mV, at most {std_mv.max():.2f} mV",
        "points less curve": f"{result.rms_mv:.2f} mV RMS, at most {result.max_mv:.2f} mV",
        f"the same at SOC {STEEP:g} to {1.0 - STEEP:g}": f"{result.rms_inside_mv:.2f} mV RMS",
    }
    if result.captures:
        left_mv = 1e3 * np.abs(result.remaining_v)
        rows["left to relax at a rest's end"] = f"{np.median(left_mv):.2f} mV, at most {left_mv.max():.2f} mV"
        rows["rests that gave none"] = f"{len(result.rejected)}"
        rows["glitches left out"] = f"{sum(test.glitches for test in found.tests)}"
    if result.error_mv:
        rows["error of the curve at SOC 0, 0.1 ... 1"] = " ".join(f"{mv:.0f}" for mv in result.error_mv) + " mV"
    for name, parameter in result.parameters.items():
        std = parameter["std"]
        rows[name] = f"{parameter['value']:.5g} " + ("at its bound" if std is None else f"± {std:.2g}")
    for name, value in rows.items():
        table.add_row(name, value)
    return table


def _sources_table(result: OcvResult) -> Table:
    """Return a table of the kind that each source was recognized as."""
    table = Table("source", "found to be", "C", "off", "hysteresis", box=box.SIMPLE_HEAD)
    for source in result.sources:
        table.add_row(
            source.name,
            "\n".join([source.kind, *source.notes]),
            "" if source.temperature_c is None else f"{source.temperature_c:.0f}",
            "" if source.off_mv is None else f"{source.off_mv:.1f} mV",
            "" if source.hysteresis_mv is None else f"{source.hysteresis_mv:.1f} mV",
        )
    return table
