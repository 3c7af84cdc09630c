"""History of packs in Parquet files, as batches in order of time."""

import itertools
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import duckdb
import pyarrow as pa

from bms_estimator.fleet.ingest.arrow_batch import columns_of
from bms_estimator.fleet.ingest.batch_columns import BatchError
from bms_estimator.fleet.ingest.batch_samples import BatchReader, BatchSamples
from bms_estimator.model.errors import UserError
from bms_estimator.sources.captures.tables.layout import Column

PACK_COLUMN = "pack"
"""Column with the name of the pack. A file without this column has the samples of one pack, and is named after it."""
BATCH_ROWS = 4096
"""Maximum number of rows in memory. This number of rows with 255 cells each has fewer values than ``batch_columns.MAX_VALUES``."""
MEMORY = "1GB"
"""Memory for sorting; larger data are sorted on disk."""
DAY_S = 86_400.0
"""Duration of a day [s]."""


class PackBatch(NamedTuple):
    """Samples of one pack, in order of time."""

    pack: str
    batch: BatchSamples


def parquet_files(paths: Sequence[Path]) -> list[Path]:
    """Return the Parquet files at paths, which are files or folders.

    Raises:
        UserError: A path does not exist, or a folder has no Parquet file.
    """
    files = list[Path]()
    for path in paths:
        found = sorted(path.rglob("*.parquet")) if path.is_dir() else [path]
        if not found or not path.exists():
            raise UserError(
                f"--parquet {path}: {'no .parquet file in this folder' if path.exists() else 'does not exist'}"
            )
        files += found
    return files


def read_history(files: Sequence[Path], reader: BatchReader, folder: Path) -> Generator[PackBatch, None, None]:
    """Yield the samples of all packs day by day, and within a day pack by pack.

    Therefore all packs advance together, and several workers are busy.

    Args:
        files: The Parquet files.
        reader: Converter of columns to samples.
        folder: Folder for sorting on disk.

    Raises:
        UserError: A file cannot be read, or a column is missing or invalid.
    """
    with _database(folder) as database:
        rows = database.read_parquet([str(file) for file in files], union_by_name=True, filename=True)
        has_pack = PACK_COLUMN in rows.columns
        used = reader.used_columns([name for name in rows.columns if name not in (PACK_COLUMN, "filename")])
        pack = f"CAST({PACK_COLUMN} AS VARCHAR)" if has_pack else "parse_filename(filename, true)"
        day = f"floor({_seconds(used[0], rows)} / {DAY_S})"
        columns = ", ".join(_quoted(column.name) for column in used)
        selected = rows.project(f"{pack} AS {PACK_COLUMN}, {day} AS day, {columns}")
        ordered = selected.order(f"day, {PACK_COLUMN}, {_quoted(used[0].name)}")
        for batch in ordered.to_arrow_reader(BATCH_ROWS):
            yield from _split(batch, reader)


def _seconds(time: Column, rows: duckdb.DuckDBPyRelation) -> str:
    """Return the SQL expression of a time in seconds."""
    column_type = str(rows.types[rows.columns.index(time.name)])
    if column_type.startswith("TIMESTAMP"):
        return f"epoch({_quoted(time.name)})"
    if column_type == "VARCHAR":
        return f"epoch(TRY_CAST({_quoted(time.name)} AS TIMESTAMPTZ))"
    return f"{time.unit.factor} * {_quoted(time.name)}"


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'


def _split(rows: pa.RecordBatch, reader: BatchReader) -> Iterator[PackBatch]:
    """Yield the samples of each pack in some rows."""
    packs = rows.column(PACK_COLUMN).to_pylist()
    for pack, group in itertools.groupby(range(len(packs)), packs.__getitem__):
        numbers = list(group)
        columns = columns_of(rows.slice(numbers[0], len(numbers)).drop_columns([PACK_COLUMN, "day"]))
        try:
            yield PackBatch(pack or "", reader.read(columns))
        except BatchError as error:
            raise UserError(f"--parquet: pack {pack}: {error}") from None


@contextmanager
def _database(folder: Path) -> Iterator[duckdb.DuckDBPyConnection]:
    """Open a database in memory that sorts larger data in ``folder``.

    Raises:
        UserError: A file cannot be read.
    """
    with duckdb.connect(config={"memory_limit": MEMORY, "temp_directory": str(folder), "threads": 1}) as database:
        try:
            database.execute("SET TimeZone = 'UTC'")
            yield database
        except duckdb.Error as error:
            raise UserError(f"--parquet: {str(error).splitlines()[0]}") from None
        except BatchError as error:
            raise UserError(f"--parquet: {error}") from None
