"""``bms-estimator convert``: a capture in another format, such as the Battery Data Format (BDF) of the Battery Data Alliance.

A BDF file follows version 1.2.0 of the ontology. Its header has the preferred labels, such as ``Voltage / V``, which the
specification requires in files.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from bms_estimator.cli.options.capture_input import capture_file, long_file_bar, print_guesses, print_warnings
from bms_estimator.cli.options.capture_options import (
    CAPTURE_HELP,
    Force,
    MappedColumns,
    SignOfCurrent,
    check_output_file,
)
from bms_estimator.model.arrays import SAMPLE, Records, SampleBlock, structured_array
from bms_estimator.model.charge_count import TimeFaults
from bms_estimator.model.columns import cell_voltage_columns
from bms_estimator.model.errors import UserError
from bms_estimator.model.progress import Progress
from bms_estimator.sinks.trace_file import SINKS, CsvSink, TableSink, join_columns, table_sink
from bms_estimator.sources.captures.replay import Capture, no_samples_error, open_capture

EARLIEST_UNIX_TIME_S = 1e9
"""Earliest time that counts as a Unix time [s]: September 2001. Smaller times count from the start of the capture."""
TIME_DIGITS = 6
"""Number of decimals of the test time [s], because differences of Unix times have rounding errors."""
SUFFIXES = (".bdf", ".bdf.gz", ".bdf.csv", ".bdf.csv.gz", ".bdf.parquet")
"""File name suffixes of the format."""


def is_bdf_name(name: str) -> bool:
    """Return True if a file name has a suffix of the Battery Data Format."""
    return name.lower().endswith(SUFFIXES)


def bdf_rows(block: SampleBlock, first_s: float, *, with_temperature: bool) -> Records:
    """Return samples with the columns of the Battery Data Format.

    Args:
        block: Samples, rows of dtype ``SAMPLE``.
        first_s: Time of the capture's first sample [s], at which the test time is 0. If it is a Unix time, the result has a
            column of Unix times.
        with_temperature: True for a column of temperatures.

    Returns:
        Structured array of floats. The current is positive on charge.
    """
    columns = {
        "Test Time / s": np.round(block["time_s"] - first_s, TIME_DIGITS),
        "Voltage / V": block["voltage_v"],
        "Current / A": 0.0 - block["current_a"],  # 0.0 - 0.0 is 0.0, whereas -0.0 would be written as "-0"
    }
    if first_s >= EARLIEST_UNIX_TIME_S:
        columns["Unix Time / s"] = block["time_s"]
    if with_temperature:
        columns["Surface Temperature / degC"] = block["temperature_c"]
    return structured_array(columns)


SUFFIXES_HELP = ".csv, .csv.gz or .parquet; Battery Data Format: .bdf, .bdf.gz, .bdf.csv, .bdf.csv.gz or .bdf.parquet"
"""Formats by file name suffix."""


def convert(
    capture: Annotated[Path, typer.Argument(help=CAPTURE_HELP, show_default=False)],
    out: Annotated[
        Path,
        typer.Option(
            help=f"file to write; its suffix determines the format: {SUFFIXES_HELP}",
            show_default=False,
        ),
    ],
    current_sign: SignOfCurrent = None,
    column_map: MappedColumns = None,
    force: Force = False,
) -> None:
    """Write a capture as CSV or Parquet, with the columns of this project or of the Battery Data Format (BDF).

    The current is positive on discharge in this project's columns, and positive on charge in BDF.
    """
    check_output_file(out, [capture], force=force)
    sink, rows, faults = _sink(out), 0, TimeFaults()
    with capture_file(capture) as path, sink, long_file_bar("converting", path) as progress:

        def reopen() -> Capture:
            return open_capture(path, current_sign=current_sign, column_map=column_map)

        print_guesses(path.name, reopen())
        for block in (_bdf_blocks if is_bdf_name(out.name) else _project_blocks)(reopen, progress, faults):
            sink.write(block)
            rows += block.size
        print_warnings(path.name, faults.warnings)
        if rows == 0:
            raise no_samples_error(path, reopen())
    typer.echo(f"{out}: {rows:,} samples")


def _sink(out: Path) -> TableSink:
    """Return the sink of a file name. Missing values are empty in BDF, because most of its readers parse ``nan`` as text."""
    is_bdf_text = is_bdf_name(out.name) and not out.name.lower().endswith(".parquet")
    if is_bdf_text:
        return CsvSink(out, nan="")
    if not out.name.lower().endswith(tuple(SINKS)):
        raise UserError(f"--out {out}: the name must end in {SUFFIXES_HELP}")
    return table_sink(out)


def _blocks(capture: Capture, progress: Progress, faults: TimeFaults) -> Iterator[SampleBlock]:
    """Yield the samples of a capture, and report their times and the fraction of the file that has been read."""
    for block in capture:
        faults.add(block["time_s"])
        yield block
        progress(capture.fraction)


def _project_blocks(reopen: Callable[[], Capture], progress: Progress, faults: TimeFaults) -> Iterator[Records]:
    """Yield the samples of a capture in this project's columns. A first pass finds the columns without values, which are omitted.

    Args:
        reopen: Function that opens the capture for one pass.
        progress: Receives the fraction of the file that has been converted.
        faults: Receives the times.
    """
    columns, cells = _columns_with_values(reopen())
    capture = reopen()
    for block in _blocks(capture, progress, faults):
        samples = block[columns]
        yield join_columns(samples, cell_voltage_columns(capture.cells, block.size, cells)) if cells else samples


def _columns_with_values(capture: Capture) -> tuple[list[str], int]:
    """Return the columns of a capture's samples, and the number of cells with a voltage.

    A status requires the temperature column, because readers recognize a status only in a table with the columns of a sample.
    """
    *columns, temperature, lowest, highest, status = SAMPLE.names or ()
    has_temperature = has_probes = has_status = False
    cells = 0
    for block in capture:
        has_status |= bool(block["status"].any())
        has_temperature |= bool(np.isfinite(block["temperature_c"]).any())
        has_probes |= bool((block[lowest] < block[highest]).any())
        if np.isfinite(capture.cells).any():
            cells = max(cells, capture.cells.shape[1])
    if has_temperature or has_status:
        columns.append(temperature)
    return columns + [lowest, highest] * has_probes + [status] * has_status, cells


def _bdf_blocks(reopen: Callable[[], Capture], progress: Progress, faults: TimeFaults) -> Iterator[Records]:
    """Yield the samples of a capture in the Battery Data Format.

    The first pass reads up to the first temperature, to decide whether the file has a column for it.

    Args:
        reopen: Function that opens the capture for one pass.
        progress: Receives the fraction of the file that has been converted.
        faults: Receives the times.
    """
    with_temperature = any(np.isfinite(block["temperature_c"]).any() for block in reopen())
    first_s = None
    for block in _blocks(reopen(), progress, faults):
        if first_s is None:
            first_s = float(block["time_s"][0])
        yield bdf_rows(block, first_s, with_temperature=with_temperature)
