"""``bms-estimator identify`` for a fuel cell: parameters from polarization curves and records."""

import json
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from rich import box
from rich.console import Console, Group
from rich.table import Table

from bms_estimator.calibration.fuel_cell_fit import KEYS, FuelCellFit, Source, fit_fuel_cell
from bms_estimator.cli.options.capture_input import load_captures
from bms_estimator.cli.options.capture_options import name_of, unique_names
from bms_estimator.kernels.start import MAX_PLAUSIBLE_C, MIN_PLAUSIBLE_C
from bms_estimator.model.arrays import CurrentSign, Floats, Masks
from bms_estimator.model.errors import UserError
from bms_estimator.model.pack_model import FuelCellModel, load_fuel_cell, write_cell
from bms_estimator.sources.captures.curves import read_polarisation
from bms_estimator.sources.captures.tables.layout import ColumnMap

DIGITS = 4
"""Significant digits of printed values."""
MIN_POINTS = 3
"""Minimum number of usable points in a curve or capture."""


@dataclass(frozen=True)
class IdentifiedParameter:
    """Identified parameter in the output of ``--json``."""

    value: float
    std: float | None
    """Standard deviation in the parameter's unit; None if the data do not determine the parameter."""
    of_start: float
    """Initial value, from the file of --cell."""
    reason: str | None
    """Reason why the data do not determine the parameter."""


def identify_fuel_cell(
    paths: Sequence[Path],
    cell: str,
    out: Path,
    *,
    temperature_c: float | None,
    current_sign: CurrentSign | None,
    column_map: ColumnMap | None,
    as_json: bool,
) -> None:
    """Identify the parameters, write the file and print the result; arguments as in ``identify_command``."""
    if temperature_c is not None and not MIN_PLAUSIBLE_C <= temperature_c <= MAX_PLAUSIBLE_C:
        raise UserError(
            f"--temperature-c {temperature_c:g}: must be between {MIN_PLAUSIBLE_C:g} and {MAX_PLAUSIBLE_C:g} °C"
        )
    initial_model = load_fuel_cell(cell)
    names = unique_names([name_of(path) for path in paths], paths)
    sources = [
        _read_source(name, path, initial_model, temperature_c, current_sign, column_map)
        for name, path in zip(names, paths, strict=True)
    ]
    started_s = time.perf_counter()
    fit = fit_fuel_cell(sources, initial_model)
    duration_s = time.perf_counter() - started_s
    parameters: dict[str, IdentifiedParameter] = {
        key: IdentifiedParameter(
            value=getattr(fit.model.fuel_cell, key),
            # the cell file contains relative standard deviations
            std=fit.model.std[key] * getattr(fit.model.fuel_cell, key) if key in fit.model.std else None,
            of_start=getattr(initial_model.fuel_cell, key),
            reason=fit.undetermined.get(key),
        )
        for key in KEYS
    }
    renamed = fit.model.model_copy(update={"cell": fit.model.cell.model_copy(update={"name": name_of(out)})})
    write_cell(out, renamed, _remarks(cell, fit))
    if as_json:
        result = {"out": str(out), "parameters": {key: asdict(parameter) for key, parameter in parameters.items()}}
        rms_mv = {f"{name}_rms_mv": 1e3 * rms_v for name, rms_v in fit.rms_v.items()}
        sys.stdout.write(json.dumps(result | rms_mv | {"seconds": duration_s}) + "\n")
    else:
        Console().print(_table(out, parameters, fit, duration_s))


def _read_source(
    name: str,
    path: Path,
    model: FuelCellModel,
    temperature_c: float | None,
    sign: CurrentSign | None,
    column_map: ColumnMap | None,
) -> Source:
    """Read a polarization curve, or a capture if the file has times; drop samples outside the stack's limits."""
    curve = read_polarisation(path)
    if curve is not None:
        time_s = None
        current_a, voltage_v, sensed_c = curve.T
        current_a = -current_a if sign == "charge_positive" else current_a
    else:
        (record,) = load_captures([path], current_sign=sign, column_map=column_map)
        time_s, current_a, voltage_v, sensed_c = (
            record[name] for name in ("time_s", "current_a", "voltage_v", "temperature_c")
        )
    usable = _usable(path, model, current_a, voltage_v)
    if time_s is not None:
        usable &= np.diff(time_s, prepend=-np.inf) > 0.0  # the clock of a capture may be set back
    is_plausible = (sensed_c >= MIN_PLAUSIBLE_C) & (sensed_c <= MAX_PLAUSIBLE_C)
    default_c = math.nan if temperature_c is None else temperature_c
    return Source(
        name=name,
        time_s=None if time_s is None else time_s[usable],
        current_a=current_a[usable],
        voltage_v=voltage_v[usable],
        temperature_c=np.where(is_plausible, sensed_c, default_c)[usable],
    )


def _usable(path: Path, model: FuelCellModel, current_a: Floats, voltage_v: Floats) -> Masks:
    """Return a mask of the points within the stack's limits, shape (n,).

    Raises:
        UserError: Most currents have the wrong sign, or too few points are left.
    """
    cell = model.cell
    is_charging = current_a < -model.fuel_cell.internal_current_a
    if 2 * is_charging.sum() > is_charging.size:
        raise UserError(f"{path}: the current is negative, but a fuel cell cannot be charged: is --current-sign right?")
    usable: Masks = (voltage_v >= cell.voltage_min_v) & (voltage_v <= cell.voltage_max_v)
    usable &= (current_a <= cell.current_max_a) & ~is_charging
    if usable.sum() < MIN_POINTS:
        limits = f"{cell.voltage_min_v:g} to {cell.voltage_max_v:g} V and up to {cell.current_max_a:g} A"
        raise UserError(
            f"{path}: only {usable.sum()} usable points: at least {MIN_POINTS} are needed within the limits of {cell.name}, {limits}"
        )
    return usable


def _remarks(cell: str, fit: FuelCellFit) -> list[str]:
    """Return the comments at the beginning of the cell file."""
    fits = ", ".join(f"{name} ({1e3 * rms_v:.1f} mV RMS)" for name, rms_v in fit.rms_v.items())
    unchanged = (
        f"Unchanged, because the data do not determine them: {', '.join(fit.undetermined)}." if fit.undetermined else ""
    )
    return [line for line in (f"Identified from {fits}, initial values from {Path(cell).name}.", unchanged) if line]


def _table(out: Path, parameters: dict[str, IdentifiedParameter], fit: FuelCellFit, duration_s: float) -> Group:
    """Return a table of the parameters, with the errors and the reasons for unchanged parameters below it."""
    table = Table(title=f"{out}: written", title_justify="left", box=box.SIMPLE_HEAD)
    for column in ("", "identified", "±", "before"):
        table.add_column(column, justify="right" if column else "left")
    for key, parameter in parameters.items():
        std = "not identified" if parameter.std is None else f"{parameter.std:.2g}"
        table.add_row(key, f"{parameter.value:.{DIGITS}g}", std, f"{parameter.of_start:.{DIGITS}g}")
    residuals = [f"{name}: {1e3 * rms_v:.1f} mV RMS" for name, rms_v in fit.rms_v.items()]
    return Group(
        table, *residuals, *(f"{key}: {reason}" for key, reason in fit.undetermined.items()), f"{duration_s:.1f} s"
    )
