"""``bms-estimator validate``: comparison of a cell's model with a capture."""

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from rich import box
from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from bms_estimator.calibration.validate import Errors, Validation, soc_errors, validate
from bms_estimator.calibration.verdict import Run, Verdict, is_fitted_to, judge
from bms_estimator.cli.options.capture_input import load_captures
from bms_estimator.cli.options.capture_options import (
    CAPTURE_FORMATS,
    AsJson,
    CapacityAh,
    CellName,
    Force,
    MappedColumns,
    Series,
    SignOfCurrent,
    TemperatureWithoutSensor,
    check_output_file,
)
from bms_estimator.cli.options.pack_options import decimal, pack_or_cell, with_pack
from bms_estimator.cli.options.progress_bar import compile_ahead, progress_bar
from bms_estimator.model.arrays import Records, fill_temperature, structured_array
from bms_estimator.pack.pack import new_pack
from bms_estimator.sinks.trace_file import table_sink
from bms_estimator.telemetry.state import finite


def validate_command(
    capture: Annotated[Path, typer.Argument(help=f"capture to read: {CAPTURE_FORMATS}", show_default=False)],
    cell: CellName,
    capacity_ah: CapacityAh = None,
    soc: Annotated[
        float | None,
        typer.Option(
            parser=decimal(0.0, 1.0), help="SOC at the first sample; default: from the voltage of the first rest"
        ),
    ] = None,
    series: Series = None,
    temperature_c: TemperatureWithoutSensor = None,
    current_sign: SignOfCurrent = None,
    column_map: MappedColumns = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="file to which the residuals of each sample are written: .csv, .csv.gz or .parquet", show_default=False
        ),
    ] = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Simulate a capture's voltage from its current, and compare it with the measured voltage (open loop).

    The parameters are constant. The measured voltage is used only for the SOC of the first rest.
    """
    settings, pack_model = pack_or_cell(None, cell, capacity_ah, series)
    model = pack_model.battery(f"{pack_model.cell.name} is a fuel cell: validate needs a battery cell")
    if soc is not None:
        settings = with_pack(settings, initial_soc=soc)
    (loaded,) = load_captures([capture], current_sign=current_sign, column_map=column_map)
    is_fitted = is_fitted_to(model, loaded.rows)
    fill_temperature(loaded.rows, temperature_c)
    if out is not None:
        check_output_file(out, [capture], force=force)
    residual_sink = table_sink(out) if out else None
    validation = validate(loaded, model, initial_soc=soc)
    compile_ahead()
    pack = new_pack(settings, model, has_forecasts=False)
    with progress_bar("estimating") as bar:
        errors = soc_errors(pack, loaded.rows, validation, lambda _trace, _counted, fraction: bar.update(fraction))
    verdict = judge([Run(loaded.name, validation, errors, is_fitted)], model)
    for line in validation.warnings:
        typer.echo(f"warning: {line}", err=True)
    if residual_sink:
        with residual_sink:
            residual_sink.write(_residuals(validation))
    if as_json:
        sys.stdout.write(json.dumps(_json_result(validation, verdict)) + "\n")
    else:
        Console().print(_tables(capture, validation, verdict))


def _residuals(validation: Validation) -> Records:
    """Return time, measured and modeled voltage, error, SOC and current of each good sample."""
    columns = {
        "time_s": validation.time_s,
        "voltage_v": validation.voltage_v,
        "modeled_v": validation.modeled_v,
        "error_v": validation.error_v,
        "soc": validation.soc,
        "current_a": validation.current_a,
    }
    return structured_array(columns)


def _json_result(validation: Validation, verdict: Verdict) -> dict[str, Any]:
    above = {f"{key}_soc_above_0_1": value for key, value in _errors_as_json(validation.above).items()}
    return (
        _errors_as_json(validation.all)
        | above
        | {
            "initial_soc": validation.initial_soc,
            "initial_soc_from": validation.initial_soc_from,
            "final_soc": validation.final_soc,
            "glitches": validation.glitches,
            "resting": _errors_as_json(validation.resting),
            "loaded": _errors_as_json(validation.loaded),
            "extra_series_resistance_ohm": finite(validation.extra_ohm),
            "with_extra_series_resistance": _errors_as_json(validation.with_extra_ohm),
            "grade": verdict.grade,
            "verdict": verdict.text,
            "warnings": list(validation.warnings),
        }
    )


def _errors_as_json(errors: Errors) -> dict[str, Any]:
    return {
        "samples": errors.samples,
        "voltage_rms_mv": finite(1e3 * errors.voltage_rms_v),
        "mean_abs_percent": finite(errors.mean_abs_percent),
        "max_abs_percent": finite(errors.max_abs_percent),
    }


def _tables(capture: Path, validation: Validation, verdict: Verdict) -> Group:
    """Return a table of the errors over several sets of samples, with the SOC and the verdict below it."""
    table = Table(title=capture.name, title_justify="left", box=box.SIMPLE_HEAD)
    for column in ("", "samples", "RMS", "mean", "max"):
        table.add_column(column, justify="left" if not column else "right")
    for row, (name, errors) in enumerate(validation.named_errors.items()):
        percents = (f"{errors.mean_abs_percent:.3f} %", f"{errors.max_abs_percent:.2f} %")
        indented = f"  {name}" if row > 1 else name
        table.add_row(indented, f"{errors.samples:,}", f"{1e3 * errors.voltage_rms_v:.2f} mV", *percents)
    soc = f"SOC {validation.initial_soc:.4f} ({validation.initial_soc_from}) to {validation.final_soc:.4f}"
    return Group(table, f"{soc}; {validation.glitches} glitches skipped", "", Text(verdict.text))
