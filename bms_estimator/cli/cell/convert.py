"""``bms-estimator cell convert``: a cell file in the format of another program."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, NamedTuple

import typer

from bms_estimator.cli.options.capture_options import CELL_HELP, CapacityAh, Force, check_output_file, name_of
from bms_estimator.conversion.c_header import c_header
from bms_estimator.conversion.cell_json import cell_json, pybamm_module
from bms_estimator.model.cell import CellModel, TableOcv, load_cell, with_name
from bms_estimator.model.config_file import write_text
from bms_estimator.model.errors import UserError


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
        Path, typer.Option(help=f"file to write, its suffix gives the format: {FORMATS_HELP}", show_default=False)
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
