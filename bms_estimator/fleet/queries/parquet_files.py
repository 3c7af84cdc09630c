"""Hours of packs in Parquet files: ``date=YYYY-MM-DD/*.parquet``, written whole or not at all, and few.

A file is written under a name that no question reads, brought to the disk, and renamed. A row may be in two of them;
queries drop the duplicate. Needs pyarrow and duckdb.
"""

import os
import uuid
from collections.abc import Iterable
from datetime import UTC, date, datetime
from pathlib import Path

import duckdb
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from bms_estimator.fleet.hour_row import HOUR_S, Hour

FOLDER = "date="
BATCH, DAY, UNFINISHED = "batch-", "day-", ".part"
"""Prefixes of single files and of merged ones, and the suffix of an unfinished file."""
MANY = 48
"""Number of files at which a day is merged before its end, or again."""
ROW_GROUP = 100_000
"""Rows that a question reads at least [rows]."""
CLOSED_S = 2 * HOUR_S
"""Time after its end at which a day is closed [s]: most late blocks have arrived by then."""
MEMORY = "500MB"
"""A day of 100,000 packs has more bytes; DuckDB sorts it in parts."""
_MAGIC = b"PAR1"


def _column(annotation: object) -> pa.DataType:
    """Seven digits are more than any of the values has; files are half as large."""
    return pa.string() if annotation is str else pa.int32() if annotation is int else pa.float32()


SCHEMA = pa.schema([(name, _column(field.annotation)) for name, field in Hour.model_fields.items()])


def write(folder: Path, rows: Iterable[Hour]) -> list[Path]:
    """Rows into a new file for each of their days; they are on the disk when this returns.

    Args:
        folder: Folder of the days; created if missing.
        rows: In any order.

    Returns:
        The files.

    Raises:
        OSError: The disk takes them not; existing files are complete.
    """
    return write_table(folder, pa.Table.from_pylist([row.model_dump() for row in rows], schema=SCHEMA))


def write_table(folder: Path, table: pa.Table) -> list[Path]:
    """Write columns of ``SCHEMA``, as ``write`` does."""
    days = pc.divide(table["hour"], 24)
    return [_write_day(folder, int(day.as_py()), table.filter(pc.equal(days, day))) for day in pc.unique(days)]


def day_folder(folder: Path, day: date) -> Path:
    """Return the folder of a day's hours."""
    return folder / f"{FOLDER}{day.isoformat()}"


def _write_day(folder: Path, day: int, rows: pa.Table) -> Path:
    """``day`` is in days since 1970."""
    of_day = day_folder(folder, datetime.fromtimestamp(day * 24 * HOUR_S, UTC).date())
    if not of_day.is_dir():
        of_day.mkdir(parents=True, exist_ok=True)
        _sync(folder)
    path = of_day / f"{BATCH}{uuid.uuid4().hex}.parquet"
    unfinished = path.with_name(f".{path.name}{UNFINISHED}")
    pq.write_table(rows, unfinished, compression="zstd")
    _finish(unfinished, path)
    return path


def _finish(unfinished: Path, path: Path) -> None:
    """Bring a file to the disk, then give it its name, which is there, too, after a power cut."""
    _sync(unfinished)
    unfinished.rename(path)
    _sync(path.parent)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def to_compact(folder: Path, now_s: float) -> list[Path]:
    """Folders of days whose files should be merged: closed for the first time, or with ``MANY`` files.

    Args:
        folder: Folder of the days.
        now_s: Wall clock [s since 1970].
    """
    closed = datetime.fromtimestamp(now_s - CLOSED_S, UTC).date().isoformat()
    found = []
    for day in sorted(folder.glob(f"{FOLDER}*")):
        files = sound_files(day)
        first_time = day.name.removeprefix(FOLDER) < closed and not any(f.name.startswith(DAY) for f in files)
        if len(files) >= MANY or (first_time and files):
            found.append(day)
    return found


def compact(day: Path) -> Path:
    """One file, sorted by pack and hour, each once, in the place of all that are whole; unfinished files are removed.

    Killed at any time it loses nothing: the old files go when the new one is on the disk.

    Args:
        day: Folder of a day.

    Raises:
        OSError: The disk takes it not.
    """
    files = sound_files(day)
    path = day / f"{DAY}{uuid.uuid4().hex}.parquet"
    unfinished = path.with_name(f".{path.name}{UNFINISHED}")
    names = [str(file) for file in files]
    with duckdb.connect(config={"memory_limit": MEMORY, "temp_directory": str(day / ".sorting")}) as base:
        base.read_parquet(names, union_by_name=True, hive_partitioning=False).create_view("rows")
        each_once = base.sql("SELECT DISTINCT ON (pack, hour) * FROM rows ORDER BY pack, hour")
        each_once.write_parquet(str(unfinished), compression="zstd", row_group_size=ROW_GROUP)
    _finish(unfinished, path)
    for file in files:
        file.unlink(missing_ok=True)
    return path


def remove_unfinished(folder: Path) -> None:
    """Remove files that a killed process left unfinished; no other process may write to ``folder`` now."""
    for file in folder.glob(f"{FOLDER}*/.*{UNFINISHED}"):
        file.unlink(missing_ok=True)


def sound_files(day: Path) -> list[Path]:
    """Return the complete files of a day by name."""
    return [file for file in sorted(day.glob("*.parquet")) if is_whole(file)]


def is_whole(file: Path) -> bool:
    """Return True if a file has beginning and end of Parquet; False if it vanishes."""
    try:
        with file.open("rb") as opened:
            if opened.read(4) != _MAGIC:
                return False
            opened.seek(-4, os.SEEK_END)
            return opened.read(4) == _MAGIC
    except OSError:
        return False
