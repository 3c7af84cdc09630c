"""``bms-estimator ocv``: cell file with the open-circuit voltage from rests, slow discharges and tabulated curves."""

import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich import box
from rich.console import Console
from rich.table import Table

from bms_estimator.calibration.ocv.chen_mora_fit import NAMES, ChenMoraFit, max_v, rms_v
from bms_estimator.calibration.ocv.source import OcvSources, Recording
from bms_estimator.calibration.ocv.table_fit import TableFit
from bms_estimator.calibration.ocv_cell import OcvCell, OcvForm, determine_ocv
from bms_estimator.cli.cell.calibration_input import load_captures_and_curves
from bms_estimator.cli.options.capture_options import (
    CAPTURE_FORMATS,
    AsJson,
    Force,
    MappedColumns,
    NewCellFile,
    SignOfCurrent,
    check_output_file,
    name_of,
    reject_duplicates,
    write_cell_named_as_file,
)
from bms_estimator.cli.options.pack_options import decimal, whole
from bms_estimator.telemetry.state import finite

STEEP_SOC = 0.05
"""Width of the ranges at both ends of the SOC in which OCV curves are steep."""
TABULATED_SOC = np.linspace(0.0, 1.0, 11)
"""SOC at which the error of the table is printed."""


@dataclass(frozen=True)
class SourceResult:
    """Kind of a source and quality of its fit, in the output of ``--json``."""

    name: str
    kind: str
    points: int
    temperature_c: float | None
    off_mv: float | None
    """RMS difference of the whole source from the curve; None for the function of Chen and Rincón-Mora."""
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
    """True if no source determines the hysteresis, so that the generic cell's is used."""
    series_count: int
    points: int
    soc: list[float]
    ocv_v: list[float]
    """OCV of the points. The voltages of rests are extrapolated to infinite time."""
    std_v: list[float]
    rms_mv: float
    """RMS of points minus curve."""
    max_mv: float
    rms_inside_mv: float
    """RMS of points minus curve at SOC 0.05 to 0.95, away from the steep ends."""
    error_mv: list[float]
    """Standard deviation of the table at SOC 0, 0.1 ... 1; empty for the function of Chen and Rincón-Mora."""
    parameters: dict[str, dict[str, float | None]]
    """Values and standard deviations (None at a bound) of a16..a21, the parameters of the function of Chen and Rincón-Mora; empty for a
    table."""
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
            help=f"captures with rests or slow discharges and charges, each {CAPTURE_FORMATS}; or OCV curves (CSV)",
            show_default=False,
        ),
    ],
    out: NewCellFile,
    capacity_ah: Annotated[
        float | None,
        typer.Option(
            parser=decimal(1e-6),
            help="capacity of the cell [Ah]; required unless a capture is a slow discharge from full to empty",
            show_default=False,
        ),
    ] = None,
    form: Annotated[
        OcvForm,
        typer.Option(
            help="form of the OCV in the cell file: smooth table, or the function of Chen and Rincón-Mora's cell model"
        ),
    ] = OcvForm.TABLE,
    soc: Annotated[
        float | None,
        typer.Option(
            parser=decimal(0.0, 1.0),
            help="initial SOC, 0..1, of the captures that start at the highest voltage; required unless their first rest shows "
            "a full cell. The SOC of other captures is read from the OCV curve",
            show_default=False,
        ),
    ] = None,
    series: Annotated[
        int | None,
        typer.Option(
            parser=whole(1),
            help="number of cells in series; required for LFP packs; default: median voltage divided by 3.7 V",
            show_default=False,
        ),
    ] = None,
    current_sign: SignOfCurrent = None,
    column_map: MappedColumns = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Determine the open-circuit voltage (OCV) over SOC, and write a cell file.

    The OCV is determined from files of three kinds. The kind is detected from the content:
    captures with rests, such as HPPC or relaxation tests;
    captures of slow discharges and charges;
    OCV curves in CSV files with the columns soc, ocv_v and, optionally, hysteresis_v, std_v and per_kelvin_v.
    The files may have been recorded at different temperatures.

    The cell file also contains resistances, estimated from the rests and the most similar generic cell.
    `identify` improves these resistances.
    """
    check_output_file(out, captures, force=force)
    reject_duplicates(captures)
    loaded, curves = load_captures_and_curves(captures, current_sign=current_sign, column_map=column_map)
    recordings = [Recording(each.name, each.rows) for each in loaded]
    determined = determine_ocv(
        recordings, curves, form=form, capacity_ah=capacity_ah, initial_soc=soc, series_count=series, name=name_of(out)
    )
    result = _result(form, determined)
    write_cell_named_as_file(out, determined.cell, _remarks(result), loaded)
    if as_json:
        sys.stdout.write(json.dumps(asdict(result)) + "\n")
    else:
        console = Console()
        console.print(_table(out, result, determined.sources))
        console.print(_sources_table(result))


def _result(form: OcvForm, determined: OcvCell) -> OcvResult:
    fit, ocv_sources, generic = determined.fit, determined.sources, determined.generic
    tests, points = ocv_sources.tests, ocv_sources.points
    parameters: dict[str, dict[str, float | None]] = {}
    if isinstance(fit, ChenMoraFit):
        for name, value, std in zip(NAMES, fit.a, fit.std, strict=True):
            parameters[name] = {"value": float(value), "std": float(std) if np.isfinite(std) else None}
    return OcvResult(
        form=form.value,
        capacity_ah=ocv_sources.capacity_ah,
        capacity_measured_ah=finite(ocv_sources.measured_ah),
        generic=generic.cell.name,
        usual_hysteresis=ocv_sources.has_typical_hysteresis,
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
            temperature_c=finite(source.temperature_c),
            off_mv=1e3 * float(fit.deviation_v[i]) if isinstance(fit, TableFit) else None,
            hysteresis_mv=None if source.hysteresis_v is None else 1e3 * float(source.hysteresis_v.mean()),
            notes=list(source.notes),
        )
        for i, source in enumerate(ocv_sources.sources)
    ]


def _remarks(result: OcvResult) -> list[str]:
    """Return the comments at the beginning of the cell file."""
    generic = f"the generic {result.generic}"
    hysteresis = [f"Hysteresis: that of {generic}, because no source determines it."] if result.usual_hysteresis else []
    elements = f"estimated from the rests of one capture; their dependence on SOC and temperature is that of {generic}"
    return [
        f"OCV: {', '.join(f'{source.kind} of {source.name}' for source in result.sources)};",
        f"the {result.form} form differs from the points by {result.rms_mv:.2f} mV RMS, at most {result.max_mv:.2f} mV.",
        *hysteresis,
        f"Circuit elements: {elements if result.captures else f'those of {generic}'}. identify starts from them.",
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
