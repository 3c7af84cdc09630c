"""Captures as arguments of a command, and checks of the files that it writes.

Standard input is copied to a file, because readers need the size of a file and read it twice.
"""

import filecmp
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from bms_estimator.cli.options.pack_options import decimal, whole
from bms_estimator.model.arrays import CurrentSign, capture_digest
from bms_estimator.model.cell import CellModel, battery_names, cell_names, fitted_to, with_name
from bms_estimator.model.columns import Columns
from bms_estimator.model.errors import UserError
from bms_estimator.model.pack_model import write_cell
from bms_estimator.sources.captures.tables.layout import ColumnMap
from bms_estimator.sources.captures.tables.layout_finder import parse_column_map

AsJson = Annotated[bool, typer.Option("--json", help="print the result as one JSON object")]
"""Option that prints the result as JSON."""
CELL_HELP = "generic cell (lfp, nmc, nca, lco, lmo, lto), name of a shipped cell, or path of a cell file"
CELL_OR_FUEL_CELL_HELP = f"{CELL_HELP}; for a fuel cell: pem_30w or path of a fuel-cell file"
CAPTURE_FORMATS = (
    "a file of `record` or `run --record`, a table (CSV, Parquet, spreadsheet), the export of a cycler, "
    "or - for standard input"
)
"""Formats of a capture in help texts."""
CAPTURE_HELP = f"capture to read: {CAPTURE_FORMATS}"


def complete_battery(incomplete: str) -> list[str]:
    """Return the names of battery cells that begin with ``incomplete``."""
    return [name for name in battery_names() if name.startswith(incomplete)]


def complete_cell(incomplete: str) -> list[str]:
    """Return the names of battery cells and fuel cells that begin with ``incomplete``."""
    return [name for name in cell_names() if name.startswith(incomplete)]


CellName = Annotated[str, typer.Option(help=CELL_HELP, autocompletion=complete_battery, show_default=False)]
CapacityAh = Annotated[
    float | None,
    typer.Option(
        parser=decimal(),
        help="capacity of the cell [Ah]; required for a generic cell; default: capacity in the cell file",
        show_default=False,
    ),
]
CapturesFromRest = Annotated[
    list[Path], typer.Argument(help=f"captures that begin with a rest: {CAPTURE_FORMATS}", show_default=False)
]
InitialSoc = Annotated[
    float | None,
    typer.Option(
        parser=decimal(0.0, 1.0),
        help="SOC at the first sample of each capture; default: from the voltage of the capture's first rest",
    ),
]
SocOfEstimator = Annotated[
    float | None,
    typer.Option(
        parser=decimal(0.0, 1.0), help="initial SOC, 0..1; default: from the measured voltage, by the OCV curve"
    ),
]
NewCellFile = Annotated[Path, typer.Option(help="cell file to write", show_default=False)]
Force = Annotated[bool, typer.Option("--force", help="replace an existing output file")]
SignOfCurrent = Annotated[
    CurrentSign | None,
    typer.Option(
        metavar="SIGN",
        help="direction of positive current in the capture: discharge_positive or charge_positive; default: "
        "that of the file format, otherwise detected from the voltage",
    ),
]
TemperatureWithoutSensor = Annotated[
    float | None,
    typer.Option(
        "--temperature-c",
        parser=decimal(),
        help="temperature of the captures that have no column temperature_c [°C]; default: 25",
        show_default=False,
    ),
]
Series = Annotated[
    int | None,
    typer.Option(
        parser=whole(1), help="number of cells in series in the captures; default: the number in the settings, or 1"
    ),
]
MappedColumns = Annotated[
    ColumnMap | None,
    typer.Option(
        "--map",
        parser=parse_column_map,
        metavar="time=COLUMN,...",
        help="names of the columns with time, current, voltage and temperature, as in 'time=Time \\[ms],current=I'; a unit may "
        "follow in brackets. For a Home Assistant export give entities. sheet=SHEET selects a sheet of a spreadsheet. "
        "instance=NUMBER selects one of several batteries",
        show_default=False,
    ),
]


def check_output_file(out: Path, inputs: Sequence[Path], *, force: bool, option: str = "--out") -> None:
    """Reject an output file that is also an input, whose folder does not exist, or that exists without ``force``.

    Args:
        out: The output file.
        inputs: Input files of the command.
        force: Replace an existing file.
        option: Option that names the file, for the errors.

    Raises:
        UserError: ``out`` is one of ``inputs``, has no folder, or exists and ``force`` is not set.
    """
    if any(out.exists() and path.exists() and out.samefile(path) for path in inputs):
        raise UserError(f"{option} {out}: is also an input; name another file")
    if out.is_file() and not force:
        raise UserError(f"{option} {out}: exists already; --force replaces it")
    if not out.parent.is_dir():
        raise UserError(f"{option} {out}: cannot be written: there is no folder {out.parent}; create it")


def reject_duplicates(captures: Sequence[Path]) -> None:
    """Reject captures that are given twice, and captures with equal contents.

    Raises:
        UserError: Two captures have equal contents.
    """
    for i, path in enumerate(captures):
        for other in captures[:i]:
            if path.is_file() and other.is_file() and filecmp.cmp(path, other, shallow=False):
                reason = "given twice" if path.samefile(other) else f"has the same content as {other}"
                raise UserError(f"{path}: {reason}; the capture would count twice")


def unique_names(names: Sequence[str], paths: Sequence[Path]) -> list[str]:
    """Return the names; a name that occurs more than once is replaced by the path of the file."""
    return [name if names.count(name) == 1 else str(path) for name, path in zip(names, paths, strict=True)]


def name_of(path: Path) -> str:
    """Return the name of a capture or cell: its file name without extensions."""
    return path.name.split(".")[0]


def write_cell_named_as_file(out: Path, cell: CellModel, remarks: list[str], captures: Sequence[Columns] = ()) -> None:
    """Write a cell file that was fitted to captures.

    Its cell is named after the file, and ``remarks`` become comments at its beginning.
    """
    fitted = fitted_to(cell, [capture_digest(capture.rows) for capture in captures])
    write_cell(out, with_name(fitted, name_of(out)), remarks)
