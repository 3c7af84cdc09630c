"""``bms-estimator ocv``: cell file with the open-circuit voltage from rests, slow discharges and tabulated curves."""

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
from bms_estimator.calibration.elements.generic_prior import curve as generic_curve
from bms_estimator.calibration.elements.generic_prior import nearest_generic_cell, scaled_generic_ladder
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
    subtract_rc_overpotential,
)
from bms_estimator.calibration.ocv.table_fit import NODES, TableFit, fit_table
from bms_estimator.cli.options.capture_options import (
    CAPTURE_FORMATS,
    AsJson,
    Force,
    NewCellFile,
    SignOfCurrent,
    check_output_file,
    name_of,
    reject_duplicates,
    unique_names,
)
from bms_estimator.cli.options.number_options import decimal, whole
from bms_estimator.kernels.cell_model.rc_ladder import REFERENCE_C
from bms_estimator.model.cell import ELEMENTS, Cell, CellModel, Ladder
from bms_estimator.model.cell_file import write_cell
from bms_estimator.model.errors import UserError
from bms_estimator.sources.captures.curves import read_curve
from bms_estimator.sources.captures.replay import load_capture

TYPICAL_CELL_V = 3.7
"""Voltage of one Li-ion cell at half charge [V], from which the number of cells in series is estimated."""
MIN_CELL_V = 1.5
"""Minimum plausible voltage of one cell at half charge [V]."""
MAX_CELL_V = 4.5
"""Maximum plausible voltage of one cell at half charge [V]."""
MAX_CELLS = 300
"""Maximum plausible number of cells in series."""
MIN_VOLTAGE_RATIO = 0.55
"""Minimum voltage of a valid sample as a fraction of the OCV at SOC 0.5: 2.0 V for a cell of 3.7 V, below usual cut-offs."""
MAX_VOLTAGE_RATIO = 1.06
"""Maximum voltage of a valid sample as a fraction of the OCV at SOC 1: 4.45 V for a cell of 4.2 V, above usual overcharge."""
MIN_EMPTY_RATIO = 0.25
"""Minimum plausible ratio of the OCV at SOC 0 to that at SOC 0.5."""
MEASURED_CAPACITY_STD = 0.03
"""Relative standard deviation of a capacity measured by a slow discharge. It covers the gain of the current sensor,
differences between cells of the type, and ageing over some years."""
MIN_CURRENT_LIMIT_C = 5.0
"""Minimum C-rate of ``current_max_a`` in the written cell file, the limit above which a sample is not valid [1/h]."""
PEAK_CURRENT_MARGIN = 1.5
"""Minimum ratio of ``current_max_a`` in the written cell file to the largest current in the captures."""
STEEP_SOC = 0.05
"""Width of the ranges at both ends of the SOC in which OCV curves are steep."""
TABULATED_SOC = np.linspace(0.0, 1.0, 11)
"""SOC at which the error of the table is printed."""


class Form(StrEnum):
    """Form of the open-circuit voltage in the cell file."""

    CHEN_MORA = "chen-mora"
    """Function (2.10) of the thesis, after Chen and Mora."""
    TABLE = "table"
    """Smooth table over SOC."""


@dataclass(frozen=True)
class SourceResult:
    """Kind of a source and quality of its fit, in the output of ``--json``."""

    name: str
    kind: str
    points: int
    temperature_c: float | None
    off_mv: float | None
    """RMS difference of the whole source from the curve; None for (2.10) of the thesis."""
    hysteresis_mv: float | None
    """Mean hysteresis over SOC."""
    notes: list[str]


@dataclass(frozen=True)
class OcvResult:
    """Output of ``--json``."""

    form: str
    capacity_ah: float
    capacity_measured_ah: float | None
    """Capacity by a slow discharge from full to empty; None without such a discharge."""
    generic: str
    """Most similar generic cell. Its resistances are scaled to the resistances of the captures."""
    usual_hysteresis: bool
    """True if the hysteresis is that of the generic cell, because no source determines it."""
    series_count: int
    points: int
    soc: list[float]
    ocv_v: list[float]
    """OCV of the points; that of rests is extrapolated to infinite time."""
    std_v: list[float]
    rms_mv: float
    """RMS of points minus curve."""
    max_mv: float
    rms_inside_mv: float
    """RMS of points minus curve at SOC 0.05 to 0.95, away from the steep ends."""
    error_mv: list[float]
    """Standard deviation of the table at SOC 0, 0.1 ... 1; empty for (2.10) of the thesis."""
    parameters: dict[str, dict[str, float | None]]
    """Values and standard deviations (None at a bound) of a16..a21, the parameters of (2.10); empty for a table."""
    sources: list[SourceResult]
    captures: dict[str, dict[str, float]]
    """Numbers of rests and glitches and the final SOC, by capture with rests."""
    remaining_v: list[float]
    """Remaining relaxation at the end of each rest."""
    rejected: list[str]


def ocv(
    captures: Annotated[
        list[Path],
        typer.Argument(
            help=f"captures with rests or slow discharges and charges, each a {CAPTURE_FORMATS}; or OCV curves (CSV)",
            show_default=False,
        ),
    ],
    out: NewCellFile,
    capacity_ah: Annotated[
        float | None,
        typer.Option(
            parser=decimal(1e-6),
            help="capacity with which the SOC is counted [Ah]; default: capacity measured by a slow discharge",
            show_default=False,
        ),
    ] = None,
    form: Annotated[
        Form,
        typer.Option(
            help="form of the OCV in the cell file: smooth table, or the function of Chen and Rincón-Mora's cell model"
        ),
    ] = Form.TABLE,
    soc: Annotated[
        float,
        typer.Option(
            parser=decimal(0.0, 1.0),
            help="initial SOC of the captures that start at the highest voltage; that of other captures is read from the OCV curve",
        ),
    ] = 1.0,
    series: Annotated[
        int | None,
        typer.Option(
            parser=whole(1),
            help="number of cells in series; required for LFP packs; default: median voltage divided by 3.7 V, which is too high for LFP",
            show_default=False,
        ),
    ] = None,
    current_sign: SignOfCurrent = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Determine the open-circuit voltage (OCV) over SOC, and write a cell file.

    The OCV is determined from files of three kinds. The kind is detected from the content:
    captures with rests, such as HPPC or relaxation tests;
    captures of slow discharges and charges;
    OCV curves in CSV files with the columns soc, ocv_v and, optionally, hysteresis_v.
    The files may have been recorded at different temperatures.

    The cell file also contains resistances, estimated from the rests and the most similar generic cell.
    `identify` improves these resistances.
    """
    check_output_file(out, captures, force=force)
    reject_duplicates(captures)
    recordings, curves = [], []
    for name, path in zip(unique_names([path.name for path in captures], captures), captures, strict=True):
        columns = read_curve(path)
        if columns is None:
            recordings.append(Recording(name, load_capture(path, current_sign=current_sign).rows))
        else:
            curves.append(ExternalCurve(name, *columns))
    voltages_v = [_checked_voltage(recording) for recording in recordings]
    series_count = _cells_in_series(np.concatenate([*voltages_v, *(curve.ocv_v for curve in curves)]), series)
    ocv_sources = find_sources(recordings, curves, capacity_ah=capacity_ah, initial_soc=soc, series_count=series_count)
    fit_curve: Callable[[Points], ChenMoraFit | TableFit] = fit_table if form is Form.TABLE else fit_chen_mora
    # unpaired curves still contain the overpotential of RC pairs, which are known only with the generic cell
    preliminary_v = fit_curve(ocv_sources.points)(NODES)
    generic = nearest_generic_cell(NODES, preliminary_v, ocv_sources.capacity_ah, series_count)
    ladder, elements = _elements(generic, ocv_sources, recordings)
    ocv_sources = subtract_rc_overpotential(ocv_sources, ladder)
    # the two phases of a plateau cause hysteresis, which the form chen-mora does not have
    if form is Form.TABLE and ocv_sources.hysteresis_v is None and has_plateau(NODES, preliminary_v, series_count):
        ocv_sources = center_on_typical_hysteresis(
            ocv_sources, np.interp(NODES, *generic_curve(generic, "hysteresis_v"))
        )
    fit = fit_curve(ocv_sources.points)
    _check_ends(fit, ocv_sources)
    result = _result(form, generic, fit, ocv_sources)
    sections = _cell_and_ocv_sections(name_of(out), series_count, fit, ocv_sources, recordings)
    write_cell(out, CellModel.model_validate({**sections, "ladder": ladder, **elements}), _remarks(result))
    if as_json:
        sys.stdout.write(json.dumps(asdict(result)) + "\n")
    else:
        console = Console()
        console.print(_table(out, result, ocv_sources))
        console.print(_sources_table(result))


def _checked_voltage(recording: Recording) -> NDArray[np.float64]:
    """Return the voltage without glitches [V].

    Raises:
        UserError: The voltage is constant.
    """
    voltage_v = remove_glitches(recording.samples, recording.name)["voltage_v"]
    if np.ptp(voltage_v) == 0.0:
        raise UserError(f"{recording.name}: the voltage is {voltage_v[0]:g} V throughout: is the sensor connected?")
    return voltage_v


def _cells_in_series(voltage_v: NDArray[np.float64], configured: int | None) -> int:
    """Return the configured number of cells in series, or an estimate from the median voltage.

    Raises:
        UserError: The voltage of one cell would be implausible.
    """
    median_v = float(np.median(voltage_v))
    count = configured or max(round(median_v / TYPICAL_CELL_V), 1)
    if not configured and count > MAX_CELLS:
        raise UserError(
            f"the median voltage is {median_v:g} V, as of {count} cells in series; if the column is in millivolts, convert it to volts, otherwise give --series"
        )
    if not MIN_CELL_V <= median_v / count <= MAX_CELL_V:
        raise UserError(f"--series {count}: {median_v:g} V would be {median_v / count:.2f} V per cell")
    return count


def _check_ends(fit: ChenMoraFit | TableFit, ocv_sources: OcvSources) -> None:
    """Check that the curve, extrapolated beyond its points, does not fall to 0 V.

    Raises:
        UserError: The OCV at SOC 0 is implausible.
    """
    empty_v, half_full_v = (float(v) for v in fit(np.array([0.0, 0.5])))
    if empty_v > MIN_EMPTY_RATIO * half_full_v:
        return
    raise UserError(
        f"the points begin at SOC {ocv_sources.points.soc[0]:.2f}, and their curve would be {empty_v:.2f} V at SOC 0: give captures "
        f"down to empty; if the cell was emptied, the capacity of {ocv_sources.capacity_ah:g} Ah is too large (--capacity-ah)"
    )


def _result(form: Form, generic: CellModel, fit: ChenMoraFit | TableFit, ocv_sources: OcvSources) -> OcvResult:
    tests, points = ocv_sources.tests, ocv_sources.points
    parameters: dict[str, dict[str, float | None]] = {}
    if isinstance(fit, ChenMoraFit):
        for name, value, std in zip(NAMES, fit.a, fit.std, strict=True):
            parameters[name] = {"value": float(value), "std": float(std) if np.isfinite(std) else None}
    return OcvResult(
        form=form.value,
        capacity_ah=ocv_sources.capacity_ah,
        capacity_measured_ah=_finite_or_none(ocv_sources.measured_ah),
        generic=generic.cell.name,
        usual_hysteresis=ocv_sources.usual_hysteresis,
        series_count=generic.cell.series_count,
        points=points.soc.size,
        soc=points.soc.tolist(),
        ocv_v=points.ocv_v.tolist(),
        std_v=points.std_v.tolist(),
        rms_mv=1e3 * rms_v(fit.residual_v),
        max_mv=1e3 * max_v(fit.residual_v),
        rms_inside_mv=1e3 * rms_v(fit.residual_v[(points.soc > STEEP_SOC) & (points.soc < 1.0 - STEEP_SOC)]),
        error_mv=(1e3 * fit.error_at(TABULATED_SOC)).tolist() if isinstance(fit, TableFit) else [],
        parameters=parameters,
        sources=_source_results(fit, ocv_sources),
        captures={
            test.name: {"rests": len(test.rests), "glitches": test.glitches, "soc_final": test.end_soc}
            for test in tests
        },
        remaining_v=[rest.remaining_v for test in tests for rest in test.rests],
        rejected=[reason for test in tests for reason in test.rejected],
    )


def _source_results(fit: ChenMoraFit | TableFit, ocv_sources: OcvSources) -> list[SourceResult]:
    return [
        SourceResult(
            name=source.name,
            kind=source.kind,
            points=source.points.soc.size,
            temperature_c=_finite_or_none(source.temperature_c),
            off_mv=1e3 * float(fit.deviation_v[i]) if isinstance(fit, TableFit) else None,
            hysteresis_mv=None if source.hysteresis_v is None else 1e3 * float(source.hysteresis_v.mean()),
            notes=list(source.notes),
        )
        for i, source in enumerate(ocv_sources.sources)
    ]


def _finite_or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _elements(
    generic: CellModel, ocv_sources: OcvSources, recordings: list[Recording]
) -> tuple[Ladder, dict[str, object]]:
    """Return resistances over SOC, and the thesis's parameters a1..a15 of R_s and two RC pairs by section of the file.

    Both come from the rests of the capture nearest to 25 °C; without rests, from the generic cell.
    """
    test = _nearest_to_reference(ocv_sources.tests)
    if test is None:
        return scaled_generic_ladder(generic, None), {element: getattr(generic, element) for element in ELEMENTS}
    samples = next(recording.samples for recording in recordings if recording.name == test.name)
    rest_elements = initial_elements(samples, test, ocv_sources.capacity_ah)
    temperature_c = float(np.nan_to_num(test.temperature_c, nan=REFERENCE_C))
    return scaled_generic_ladder(generic, rest_elements, temperature_c), dict(rest_elements.sections)


def _cell_and_ocv_sections(
    name: str, series_count: int, fit: ChenMoraFit | TableFit, ocv_sources: OcvSources, recordings: list[Recording]
) -> dict[str, object]:
    """Return the section ``cell``, which contains the limits of a valid sample, and the section ``ocv``."""
    half_full_v, full_v = (float(v) for v in fit(np.array([0.5, 1.0])))
    empty_v = float(fit(np.array([0.0]))[0])
    peak_a = max((float(np.nanmax(np.abs(each.samples["current_a"]))) for each in recordings), default=0.0)
    cell = Cell(
        name=name,
        capacity_ah=round(ocv_sources.capacity_ah, 4),
        capacity_std=MEASURED_CAPACITY_STD if ocv_sources.capacity_ah == ocv_sources.measured_ah else None,
        series_count=series_count,
        nominal_voltage_v=round(half_full_v, 2),
        voltage_min_v=round(min(MIN_VOLTAGE_RATIO * half_full_v, empty_v), 2),
        voltage_max_v=round(MAX_VOLTAGE_RATIO * full_v, 2),
        current_max_a=round(max(MIN_CURRENT_LIMIT_C * ocv_sources.capacity_ah, PEAK_CURRENT_MARGIN * peak_a), 3),
    )
    ocv = fit.ocv if isinstance(fit, ChenMoraFit) else fit.table(ocv_sources.hysteresis_v, ocv_sources.hysteresis_std_v)
    return {"cell": cell, "ocv": ocv}


def _nearest_to_reference(tests: Sequence[RelaxationTest]) -> RelaxationTest | None:
    """Return the test nearest to 25 °C; the first test if none has a temperature."""
    distance_k = [np.nan_to_num(abs(test.temperature_c - REFERENCE_C), nan=np.inf) for test in tests]
    return tests[int(np.argmin(distance_k))] if tests else None


def _remarks(result: OcvResult) -> list[str]:
    """Return the comments at the beginning of the cell file."""
    generic = f"the generic {result.generic}"
    hysteresis = [f"Hysteresis: that of {generic}, because no source determines it."] if result.usual_hysteresis else []
    elements = f"values from the rests of one capture, with the dependence on SOC and temperature of {generic}"
    return [
        f"OCV: {', '.join(f'{source.kind} of {source.name}' for source in result.sources)};",
        f"the {result.form} form differs from the points by {result.rms_mv:.2f} mV RMS, at most {result.max_mv:.2f} mV.",
        *hysteresis,
        f"Elements: {elements if result.captures else f'those of {generic}'}; initial values for identify.",
    ]


def _table(out: Path, result: OcvResult, ocv_sources: OcvSources) -> Table:
    """Return a table of the result without the sources."""
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
        "std of a point": f"{np.median(std_mv):.2f} mV median, at most {std_mv.max():.2f} mV",
        "points minus curve": f"{result.rms_mv:.2f} mV RMS, at most {result.max_mv:.2f} mV",
        f"points minus curve, SOC {STEEP_SOC:g} to {1.0 - STEEP_SOC:g}": f"{result.rms_inside_mv:.2f} mV RMS",
    }
    if result.captures:
        remaining_mv = 1e3 * np.abs(result.remaining_v)
        rows["relaxation after a rest"] = (
            f"{np.median(remaining_mv):.2f} mV median, at most {remaining_mv.max():.2f} mV"
        )
        rows["rejected rests"] = f"{len(result.rejected)}"
        rows["skipped glitches"] = f"{sum(test.glitches for test in ocv_sources.tests)}"
    if result.error_mv:
        rows["error of the curve at SOC 0, 0.1 ... 1"] = " ".join(f"{mv:.0f}" for mv in result.error_mv) + " mV"
    for name, parameter in result.parameters.items():
        std = parameter["std"]
        rows[name] = f"{parameter['value']:.5g} " + ("at its bound" if std is None else f"± {std:.2g}")
    for name, value in rows.items():
        table.add_row(name, value)
    return table


def _sources_table(result: OcvResult) -> Table:
    """Return a table with the recognized kind of each source."""
    table = Table("source", "recognized as", "°C", "RMS error", "hysteresis", box=box.SIMPLE_HEAD)
    for source in result.sources:
        table.add_row(
            source.name,
            "\n".join([source.kind, *source.notes]),
            "" if source.temperature_c is None else f"{source.temperature_c:.0f}",
            "" if source.off_mv is None else f"{source.off_mv:.1f} mV",
            "" if source.hysteresis_mv is None else f"{source.hysteresis_mv:.1f} mV",
        )
    return table
