"""Captures as arguments of a command, and checks of the files that it writes.

Standard input is copied to a file, because readers need the size of a file and read it twice.
"""

import filecmp
import shutil
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer

from bms_estimator.cli.options.output import progress_bar
from bms_estimator.cli.options.pack_options import decimal, whole
from bms_estimator.model.arrays import CurrentSign, SampleBlock, capture_digest
from bms_estimator.model.cell import CellModel, battery_names, cell_names, fitted_to, with_name
from bms_estimator.model.charge_count import TimeFaults, gap_warnings
from bms_estimator.model.columns import Columns
from bms_estimator.model.errors import UserError
from bms_estimator.model.pack_model import write_cell
from bms_estimator.model.progress import Progress, no_progress
from bms_estimator.sources.captures.replay import Capture, open_capture, read_samples
from bms_estimator.sources.captures.tables.layout import ColumnMap
from bms_estimator.sources.captures.tables.layout_finder import parse_column_map

DISPLAY_NAME = "stdin"
"""Name of standard input in messages."""


@contextmanager
def standard_input() -> Iterator[Path]:
    """Copy stdin to a temporary file; yield its path, and delete it on exit.

    Raises:
        UserError: Stdin is closed. An error raised inside the context shows ``stdin`` instead of the temporary path.
    """
    if not sys.stdin:
        raise UserError(f"{DISPLAY_NAME}: closed; nothing can be read from it")
    with TemporaryDirectory() as folder:
        path = Path(folder) / DISPLAY_NAME
        with path.open("wb") as file:
            shutil.copyfileobj(sys.stdin.buffer, file)
        try:
            yield path
        except UserError as error:
            raise UserError(str(error).replace(str(path), DISPLAY_NAME)) from None


LONG_FILE_BYTES = 5_000_000
"""Size from which a bar is shown while a file is read. Smaller files are read within a few seconds."""


@contextmanager
def capture_file(path: Path) -> Iterator[Path]:
    """Yield the path of a capture; for ``-``, a temporary copy of standard input."""
    if str(path) != "-":
        yield path
        return
    with standard_input() as copy:
        yield copy


@contextmanager
def capture_files(paths: Sequence[Path]) -> Iterator[list[Path]]:
    """Yield the paths of captures; for ``-``, a temporary copy of standard input."""
    with ExitStack() as stack:
        yield [stack.enter_context(capture_file(path)) for path in paths]


def load_captures(
    paths: Sequence[Path], *, current_sign: CurrentSign | None, column_map: ColumnMap | None
) -> list[Columns]:
    """Load captures, and print what was guessed about them.

    Raises:
        UserError: A capture cannot be read.
    """
    loaded = []
    for path in paths:
        with capture_file(path) as file:
            capture = open_capture(file, current_sign=current_sign, column_map=column_map)
            print_guesses(file.name, capture)
            rows = read_with_bar(file, capture)
            faults = TimeFaults()
            faults.add(rows["time_s"])
            print_warnings(file.name, [*faults.warnings, *gap_warnings(rows["time_s"], rows["current_a"])])
            loaded.append(Columns(rows, file.name, capture.note, capture.warning))
    return loaded


def read_with_bar(file: Path, capture: Capture) -> SampleBlock:
    """Return all samples of a capture. A bar is shown while a long file is read.

    Raises:
        UserError: The file cannot be read.
    """
    with long_file_bar("reading", file) as progress:
        return read_samples(capture, progress)


@contextmanager
def long_file_bar(label: str, file: Path) -> Iterator[Progress]:
    """Yield a function that draws the finished fraction of a file on a bar. For a short file it draws nothing."""
    if not file.exists() or file.stat().st_size < LONG_FILE_BYTES:
        yield no_progress
        return
    with progress_bar(f"{label} {file.name}") as bar:
        yield bar.update


def print_guesses(name: str, capture: Capture) -> None:
    """Print on stderr what was guessed about a capture, and what contradicts it."""
    if capture.note:
        typer.echo(f"{name}: {capture.note}", err=True)
    print_warnings(name, [capture.warning] if capture.warning else [])


def print_warnings(name: str, warnings: Sequence[str]) -> None:
    """Print warnings about a capture on stderr."""
    for warning in warnings:
        typer.echo(f"warning: {name}: {warning}", err=True)


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
        "follow in brackets. In a Home Assistant export they are entities. sheet=SHEET selects a sheet of a spreadsheet. "
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
