"""Captures as arguments of a command: files or standard input. Guesses about their format are printed on stderr.

Standard input is copied to a file, because readers need the size of a file and read it twice.
"""

import shutil
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import typer

from bms_estimator.cli.options.progress_bar import progress_bar
from bms_estimator.model.arrays import CurrentSign, SampleBlock
from bms_estimator.model.charge_count import TimeFaults, gap_warnings
from bms_estimator.model.columns import Columns
from bms_estimator.model.errors import UserError
from bms_estimator.model.progress import Progress, no_progress
from bms_estimator.sources.captures.replay import Capture, open_capture, read_samples
from bms_estimator.sources.captures.tables.layout import ColumnMap

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
