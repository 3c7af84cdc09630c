"""``bms-estimator cell``: ``export`` writes a cell file from the learned state, ``convert`` another program's format."""

import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer

from bms_estimator.checkpoint.state_files import StateFiles
from bms_estimator.cli.options.capture_options import (
    CELL_HELP,
    AsJson,
    CapacityAh,
    Force,
    NewCellFile,
    check_output_file,
    name_of,
    write_cell_named_as_file,
)
from bms_estimator.cli.options.pack_options import load_pack, single_cell_of
from bms_estimator.conversion.circuit import c_header
from bms_estimator.conversion.json_and_pybamm import cell_json, pybamm_module
from bms_estimator.estimator.identified_parameters import (
    fitted_ocv_correction,
    identified_cell,
    ocv_correction_with_std,
    relative_capacity,
)
from bms_estimator.model.cell import CellModel, load_cell, with_name
from bms_estimator.model.cell_sections import TableOcv
from bms_estimator.model.config_file import write_text
from bms_estimator.model.errors import UserError
from bms_estimator.process.state_folder import state_folder


class CellFormat(NamedTuple):
    """Format of another program."""

    name: str
    text: Callable[[CellModel], str]
    """Function that returns the text of the file."""


FORMATS = {
    ".py": CellFormat("parameters for PyBaMM and PyBOP", pybamm_module),
    ".json": CellFormat("JSON", cell_json),
    ".h": CellFormat("C header", c_header),
}
"""Formats by file name suffix."""
FORMATS_HELP = ", ".join(f"{suffix} ({cell_format.name})" for suffix, cell_format in FORMATS.items())


def convert(
    cell: Annotated[str, typer.Argument(help=CELL_HELP, show_default=False)],
    out: Annotated[
        Path, typer.Option(help=f"file to write; its suffix determines the format: {FORMATS_HELP}", show_default=False)
    ],
    capacity_ah: CapacityAh = None,
    force: Force = False,
) -> None:
    """Write a cell file in the format of another program: PyBaMM, PyBOP, JSON, or C for firmware."""
    cell_format = FORMATS.get(out.suffix)
    if cell_format is None:
        raise UserError(f"--out {out}: the name must end in {FORMATS_HELP}")
    if out.suffix == ".py" and not out.stem.isidentifier():
        raise UserError(f"--out {out}: Python cannot import a module of this name; use letters, digits and underscores")
    check_output_file(out, [Path(cell)], force=force)
    model = with_name(load_cell(cell, capacity_ah), name_of(out))
    write_text(out, cell_format.text(model))
    typer.echo(f"{out}: {cell_format.name}, {model.cell.capacity_ah:.4g} Ah")
    for note in _notes(out.suffix, model):
        typer.echo(f"note: {note}", err=True)


def _notes(suffix: str, cell: CellModel) -> list[str]:
    """Return notes on how the written model differs from the model in the cell file."""
    notes = []
    hysteresis_v = cell.ocv.hysteresis_v if isinstance(cell.ocv, TableOcv) else None
    if suffix == ".py" and hysteresis_v and max(hysteresis_v) > 0.0:
        notes.append(
            "PyBaMM's Thevenin model has no hysteresis: the written OCV is the mean of charge and discharge, which "
            f"differ from it by up to {1e3 * max(hysteresis_v):.3g} mV"
        )
    if suffix == ".h" and cell.ladder is None:
        notes.append(
            "the cell file has no [ladder]: the header has the RC ladder that `run` and `replay` compute for it"
        )
    return notes


TABULATED_SOC = np.linspace(0.0, 1.0, 11)
"""SOC at which corrections and errors of the OCV are printed."""


@dataclass(frozen=True)
class ExportResult:
    """Output of ``--json``."""

    out: str
    checkpoint: str
    capacity_ah: float
    capacity_std_ah: float
    r_s_factor: float
    """Learned R_s divided by R_s of the configured cell."""
    ocv_correction_mv: list[float]
    """Correction of the OCV at SOC 0, 0.1 ... 1, for the cell or module that the cell file describes."""
    ocv_error_mv: list[float]
    """Standard deviation of the corrected OCV at SOC 0, 0.1 ... 1, for the cell or module that the cell file describes."""


def export(
    pack: Annotated[Path, typer.Argument(help="settings file of the pack, pack.toml", show_default=False)],
    out: NewCellFile,
    checkpoint: Annotated[
        Path | None,
        typer.Option(
            help="checkpoint file; default: checkpoint in the state folder of the pack's service", show_default=False
        ),
    ] = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Write a cell file from a pack's checkpoint: learned OCV, capacity and resistances, with standard deviations.

    A service whose settings name this cell file starts with the learned values.
    """
    settings, model = load_pack(pack)
    cell, series = single_cell_of(pack, settings), settings.pack.series
    files = StateFiles(checkpoint.parent if checkpoint else state_folder(settings), settings, model)
    file = files.checkpoint
    if checkpoint:  # its name may differ from the name that a service gives
        file.path = checkpoint
    check_output_file(out, [pack, file.path], force=force)
    if checkpoint and not checkpoint.exists():
        raise UserError(f"--checkpoint {checkpoint}: no such file")
    estimator = files.saved_pack().pack.estimator
    learned = identified_cell(estimator, cell, series)
    correction_v, std_v = ocv_correction_with_std(estimator.record[0], estimator.settings_record[0], TABULATED_SOC)
    correction_v += fitted_ocv_correction(estimator, TABULATED_SOC)
    capacity, cell_ah = relative_capacity(estimator.record[0]), cell.cell.capacity_ah
    result = ExportResult(
        out=str(out),
        checkpoint=str(file.path),
        capacity_ah=capacity.value * cell_ah,
        capacity_std_ah=capacity.std * cell_ah,
        r_s_factor=learned.r_s.offset_ohm / cell.r_s.offset_ohm,
        ocv_correction_mv=(1e3 * correction_v / series).tolist(),
        ocv_error_mv=(1e3 * std_v / series).tolist(),
    )
    write_cell_named_as_file(out, learned, _remarks(result, settings.pack.cell))
    typer.echo(json.dumps(asdict(result)) if as_json else _text(result, settings.pack.cell))


def _remarks(result: ExportResult, cell: str) -> list[str]:
    return [
        f"Learned by a service from {Path(cell).name}: capacity {result.capacity_ah:.4g} +- {result.capacity_std_ah:.2g} Ah,",
        f"series resistance times {result.r_s_factor:.3f}, OCV corrected by {_rms(result.ocv_correction_mv):.1f} mV RMS.",
    ]


def _text(result: ExportResult, cell: str) -> str:
    correction, error = (
        " ".join(f"{mv:.0f}" for mv in column) for column in (result.ocv_correction_mv, result.ocv_error_mv)
    )
    return (
        f"{result.out}: written from {result.checkpoint}\n"
        f"capacity {result.capacity_ah:.4g} ± {result.capacity_std_ah:.2g} Ah; "
        f"series resistance {result.r_s_factor:.3f} times that of {Path(cell).name}\n"
        f"OCV at SOC 0, 0.1 ... 1 corrected by {correction} mV, std {error} mV"
    )


def _rms(values: list[float]) -> float:
    return math.sqrt(sum(value**2 for value in values) / len(values))


app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    help="Write a cell file from a pack's learned state, or convert a cell file for another program.",
)
app.command()(export)
app.command()(convert)
