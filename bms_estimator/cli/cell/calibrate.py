"""``bms-estimator calibrate``: cell file from captures of any kind, or from a guided test of a pack.

It prints tables or JSON, and writes comments into the cell file.
"""

import json
import math
import sys
import textwrap
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer
from rich import box
from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from bms_estimator.calibration.automatic.calibrate import Calibration, calibrate
from bms_estimator.calibration.guided_test.plan import LONG, SHORT
from bms_estimator.cli.cell.calibrate_live import RelayOptions, run_guided_test
from bms_estimator.cli.cell.calibration_input import given_cell, load_captures_and_curves, split_inputs
from bms_estimator.cli.cell.calibration_session import open_session
from bms_estimator.cli.cell.load_switch import relay_program
from bms_estimator.cli.options.capture_input import capture_files
from bms_estimator.cli.options.capture_options import (
    CAPTURE_FORMATS,
    CELL_HELP,
    AsJson,
    Force,
    MappedColumns,
    Series,
    SignOfCurrent,
    TemperatureWithoutSensor,
    check_output_file,
    name_of,
    reject_duplicates,
)
from bms_estimator.cli.options.pack_options import decimal, whole
from bms_estimator.cli.options.progress_bar import progress_bar
from bms_estimator.model.arrays import capture_digest, fill_temperature
from bms_estimator.model.cell import fitted_to
from bms_estimator.model.config_file import write_text
from bms_estimator.model.pack_model import write_cell
from bms_estimator.settings.pack import load_settings
from bms_estimator.sources.captures.curves import read_curve
from bms_estimator.sources.captures.replay import load_capture

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
        table.add_row(
            each.capture.name.split(".")[0],
            each.kind,
            f"{each.temperature_c:.0f}" if math.isfinite(each.temperature_c) else "no sensor",
            each.determined,
        )
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
    if model.ocv is not None and model.ocv.sources.has_typical_hysteresis:
        ocv += f", with the hysteresis of the generic {model.ocv.generic.cell.name}"
    if model.identification is not None:
        return [f"OCV: {ocv}.", "Resistances: identified."]
    generic = model.ocv.generic.cell.name if model.ocv else model.cell.cell.name
    return [f"OCV: {ocv}.", f"Resistances: from the generic {generic}, because {model.reason}."]


class PlanName(StrEnum):
    """Guided tests."""

    SHORT = SHORT.name
    LONG = LONG.name


class RelayLevel(StrEnum):
    """Levels of a relay pin."""

    HIGH = "high"
    LOW = "low"


def calibrate_command(
    inputs: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE",
            help=f"captures, each {CAPTURE_FORMATS}; OCV curves (CSV) are also accepted. The first FILE may be the settings file of the "
            "measured pack, PACK.toml",
            show_default=False,
        ),
    ],
    out: Annotated[Path, typer.Option(help="cell file to write")] = Path("cell.toml"),
    cell: Annotated[
        str | None, typer.Option(help=f"{CELL_HELP}; default: the cell of PACK.toml", show_default=False)
    ] = None,
    capacity_ah: Annotated[
        float | None,
        typer.Option(
            "--capacity-ah",
            "--capacity",
            parser=decimal(1e-6),
            help="rated capacity of the cell [Ah]; required for a generic cell; default: the capacity in PACK.toml",
            show_default=False,
        ),
    ] = None,
    soc: Annotated[
        float | None,
        typer.Option(
            parser=decimal(0.0, 1.0),
            help="initial SOC, 0..1, of the captures that start at the highest voltage; default: 1 if their first rest shows a full "
            "cell, otherwise read from the voltage of this rest",
            show_default=False,
        ),
    ] = None,
    series: Series = None,
    report: Annotated[
        Path | None,
        typer.Option(help="HTML file for a report on all captures with the new cell file", show_default=False),
    ] = None,
    temperature_c: TemperatureWithoutSensor = None,
    current_sign: SignOfCurrent = None,
    column_map: MappedColumns = None,
    test: Annotated[
        PlanName,
        typer.Option(
            help="guided test, if no captures are given; after the charge, short takes 3 h 21 min, long 13.5 h"
        ),
    ] = PlanName.SHORT,
    restart: Annotated[bool, typer.Option("--restart", help="begin a new test, even if one was interrupted")] = False,
    relay: Annotated[
        RelayLevel | None,
        typer.Option(help="level of the board's relay pin that connects the load; default: the user connects it"),
    ] = None,
    relay_command: Annotated[
        str | None,
        typer.Option(
            help="program that connects the load with the argument on, and disconnects it with off", show_default=False
        ),
    ] = None,
    relay_silent_s: Annotated[
        int,
        typer.Option(
            parser=whole(1, 3600),
            help="with --relay: time without a command after which the board itself disconnects the load, in s",
        ),
    ] = 10,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Calibrate a cell: measure its capacity, OCV, hysteresis and resistances, and write a cell file.

    The command recognizes slow discharges and charges, relaxation tests, HPPC and drive cycles.
    One capture is enough. A capture for the OCV should begin with a full cell; otherwise give --soc.

    With PACK.toml alone, the command reads the pack's device and gives instructions: charge, discharge, rest.
    It recognizes the end of each step by voltage and current, and records all samples.
    After an interruption, run the same command again.

    The model is validated on data that are held back from the fit.
    The command prints the errors, and the conditions that the captures do not cover.
    """
    pack, paths = split_inputs(inputs)
    for output in (out, report):
        if output is not None:
            check_output_file(output, inputs, force=force)
    reject_duplicates(paths)
    given = given_cell(pack, cell, capacity_ah, series)
    session, recorded = None, list[Path]()
    with capture_files(paths) as files:
        captures, curves = load_captures_and_curves(files, current_sign=current_sign, column_map=column_map)
        if pack is not None and not files:
            settings = load_settings(pack)
            program = relay_program(relay_command) if relay_command else None
            options = RelayOptions(relay.value if relay else None, program, relay_silent_s)
            session = open_session(out, test.value, f"{settings.pack.name}, {given.size}", restart=restart)
            capture = run_guided_test(settings, given.pack, session, options)
            if capture is None:
                typer.echo("interrupted; the same command continues the test", err=True)
                raise typer.Exit(130)
            soc = 1.0  # the capture begins with the rest of the full pack
            captures, recorded = [capture], [session.write_capture(capture)]
        digests = [capture_digest(load_capture(file).rows) for file in recorded] or [
            capture_digest(each.rows) for each in captures
        ]
        for each in captures:
            fill_temperature(each.rows, temperature_c)
        with progress_bar("calibrating") as bar:
            calibration = calibrate(
                [given.scaled(each) for each in captures],
                given.cell,
                name=name_of(out),
                curves=curves,
                initial_soc=soc,
                report=bar.update,
            )
        verdict = calibration.verdict
        grade = verdict.grade if calibration.has_held_back_data else None
        write_cell(out, fitted_to(calibration.model.cell, digests, grade), remarks(calibration))
        if session is not None:
            session.end()
        _print_result(out, calibration, as_json=as_json)
        if report is not None:
            from bms_estimator.cli.captures.report import open_captures, report_on_captures  # noqa: PLC0415 - optional packages

            measured = [file for file in (*files, *recorded) if read_curve(file) is None]
            opened = open_captures(measured, pack, current_sign, column_map)
            capacity_ah = calibration.model.cell.cell.capacity_ah
            page = report_on_captures(
                measured,
                opened,
                pack,
                str(out),
                capacity_ah,
                soc if len(measured) == 1 else None,  # with several captures, it is not the SOC of each
                series=given.series,
                temperature_c=temperature_c,
                verdict=replace(verdict, sentences=(*verdict.sentences, calibration.validation_data)),
            )
            write_text(report, page.html())
            typer.echo(f"{report}: written", err=True)


def _print_result(out: Path, calibration: Calibration, *, as_json: bool) -> None:
    for text in calibration.warnings:
        typer.echo(f"warning: {text}", err=True)
    if as_json:
        sys.stdout.write(json.dumps(json_result(out, calibration)) + "\n")
    else:
        Console().print(result_text(out, calibration))
