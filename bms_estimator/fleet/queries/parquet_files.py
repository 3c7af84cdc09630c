"""Hourly rows of packs in Parquet files ``date=YYYY-MM-DD/*.parquet``, written atomically and merged by day.

A file is written under a name that no query reads, synced to the disk, and renamed. An hour may be in several files; the
row with the largest revision is valid. The module needs pyarrow and duckdb.
"""

import os
import uuid
from collections.abc import Iterable, Mapping
from datetime import UTC, date, datetime
from pathlib import Path

import duckdb
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from bms_estimator.fleet.hour_row import HOUR_S, Hour

DAY_FOLDER_PREFIX = "date="
"""Prefix of the name of a day's folder."""
BATCH_PREFIX = "batch-"
"""Prefix of the name of a file that was not merged."""
MERGED_PREFIX = "day-"
"""Prefix of the name of a file into which the files of a day were merged."""
QUARANTINE_FOLDER = "_quarantine"
"""Folder of the rows of packs with a wrong clock, in folders of the days on the server's clock. Readers of a folder of
Parquet files, such as pyarrow and Spark, skip names that begin with ``_``."""
PACKS_FILE = "_packs.parquet"
"""File with the packs in the server's table."""
UNFINISHED_SUFFIX = ".part"
"""Suffix of the name of an unfinished file."""
MAX_FILES_PER_DAY = 48
"""Number of files at which the files of a day are merged, even if the day has not ended or was merged before."""
ROW_GROUP = 100_000
"""Size of a row group [rows], the smallest unit that a query reads."""
DAY_CLOSE_DELAY_S = 2 * HOUR_S
"""Time after the end of a day at which its files are merged [s], because most late blocks have arrived by then."""
LATE_DELAY_S = HOUR_S
"""Minimum age of a file with late rows, before its day is merged again [s]. The delay collects further late rows, because each
merge writes the whole day."""
MERGE_MEMORY = "500MB"
"""Memory limit of a merge. DuckDB sorts a larger day, such as that of 100,000 packs, on the disk."""
_MAGIC = b"PAR1"
"""First and last bytes of a Parquet file."""


def _column_type(annotation: object) -> pa.DataType:
    """Return the type of a column. Single precision suffices for all values, and halves the size of the files."""
    types: dict[object, pa.DataType] = {
        str: pa.string(),
        str | None: pa.string(),
        int: pa.int32(),
        int | None: pa.int64(),
        list[float] | None: pa.list_(pa.float32()),
    }
    return types.get(annotation, pa.float32())


SCHEMA = pa.schema([(name, _column_type(field.annotation)) for name, field in Hour.model_fields.items()])
VALID_ROWS = "SELECT * FROM rows QUALIFY row_number() OVER (PARTITION BY pack, hour ORDER BY revision DESC NULLS LAST, samples DESC) = 1"
"""SQL query for one row of each hour and pack from ``rows``. A row without a revision is from an older worker. Two rows of
one revision differ if a worker without a checkpoint has read only the end of the hour from the stream."""


def write(folder: Path, rows: Iterable[Hour]) -> list[Path]:
    """Write rows to a new file for each of their days, and sync the files to the disk.

    Rows with an error of the edge's clock are written to ``QUARANTINE_FOLDER``, by the day of their arrival.

    Args:
        folder: Folder of the Parquet files; created if missing.
        rows: Rows in any order.

    Returns:
        The new files.

    Raises:
        OSError: A file cannot be written; existing files remain complete.
    """
    return write_table(folder, pa.Table.from_pylist([row.model_dump() for row in rows], schema=SCHEMA))


def write_table(folder: Path, table: pa.Table) -> list[Path]:
    """Write a table with the columns of ``SCHEMA``. Result and errors are those of ``write``."""
    is_clock_valid = pc.is_null(table["clock_error_s"])
    valid, quarantined = table.filter(is_clock_valid), table.filter(pc.invert(is_clock_valid))
    arrivals = pc.coalesce(quarantined["received_hour"], quarantined["hour"].cast(pa.int64()))
    return [
        *_write_days(folder, valid, valid["hour"]),
        *_write_days(folder / QUARANTINE_FOLDER, quarantined, arrivals),
    ]


def _write_days(folder: Path, table: pa.Table, hours: pa.ChunkedArray) -> list[Path]:
    """Write rows to a new file for each day of ``hours``, which has one hour for each row."""
    days = pc.divide(hours, 24)
    return [_write_day(folder, int(day.as_py()), table.filter(pc.equal(days, day))) for day in pc.unique(days)]


def write_packs(folder: Path, listed: Mapping[str, int]) -> None:
    """Write the packs in the server's table, each with the hour since which its row is in force [hours since 1970].

    Raises:
        OSError: The file cannot be written; the existing one remains complete.
    """
    columns = {"pack": pa.array(listed.keys(), pa.string()), "listed_hour": pa.array(listed.values(), pa.int64())}
    unfinished = unfinished_name(path := folder / PACKS_FILE)
    pq.write_table(pa.table(columns), unfinished, compression="zstd")
    finish(unfinished, path)


def read_packs(folder: Path) -> dict[str, int]:
    """Return the packs that ``write_packs`` has written; empty without the file."""
    if not (path := folder / PACKS_FILE).exists():
        return {}
    # read at once: pyarrow opens a file twice, and the collector may replace it in between
    columns = pq.ParquetFile(pa.BufferReader(path.read_bytes())).read().to_pydict()
    return dict(zip(columns["pack"], columns["listed_hour"], strict=True))


def day_folder(folder: Path, day: date) -> Path:
    """Return the folder of a day's hours."""
    return folder / f"{DAY_FOLDER_PREFIX}{day.isoformat()}"


def _write_day(folder: Path, day: int, rows: pa.Table) -> Path:
    """Write the rows of a day, given in days since 1970."""
    folder_of_day = day_folder(folder, datetime.fromtimestamp(day * 24 * HOUR_S, UTC).date())
    if not folder_of_day.is_dir():
        folder_of_day.mkdir(parents=True, exist_ok=True)
        _sync(folder)
    path = folder_of_day / f"{BATCH_PREFIX}{uuid.uuid4().hex}.parquet"
    unfinished = unfinished_name(path)
    pq.write_table(rows, unfinished, compression="zstd")
    finish(unfinished, path)
    return path


def unfinished_name(path: Path) -> Path:
    """Return the path under which a file is written before it is renamed to ``path``."""
    return path.with_name(f".{path.name}{UNFINISHED_SUFFIX}")


def finish(unfinished: Path, path: Path) -> None:
    """Sync an unfinished file, rename it, and sync the folder, so that the new name survives a power cut."""
    _sync(unfinished)
    unfinished.rename(path)
    _sync(path.parent)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def days_to_compact(folder: Path, now_s: float) -> list[Path]:
    """Return the folders of days whose files should be merged.

    These are the days that have ended and have a file that was not merged, and the days with at least
    ``MAX_FILES_PER_DAY`` files. A day that was merged before waits until such a file is ``LATE_DELAY_S`` old.

    Args:
        folder: Folder of the Parquet files.
        now_s: Wall clock [s since 1970].
    """
    ended_before = datetime.fromtimestamp(now_s - DAY_CLOSE_DELAY_S, UTC).date().isoformat()
    days = []
    for day in sorted(folder.glob(f"{DAY_FOLDER_PREFIX}*")):
        files = complete_files(day)
        has_ended = day.name.removeprefix(DAY_FOLDER_PREFIX) < ended_before
        if len(files) >= MAX_FILES_PER_DAY or (has_ended and _needs_merge(files, now_s)):
            days.append(day)
    return days


def _needs_merge(files: list[Path], now_s: float) -> bool:
    """Return True if the files of an ended day should be merged. ``days_to_compact`` describes the rule."""
    merged = [file for file in files if file.name.startswith(MERGED_PREFIX)]
    others = [file for file in files if file not in merged]
    if not merged:
        return bool(others)
    return len(merged) > 1 or any(file.stat().st_mtime <= now_s - LATE_DELAY_S for file in others)


def compact(day: Path) -> Path:
    """Merge the complete files of a day into one with one row of each hour, sorted by pack and hour. Return the new file.

    The old files are removed once the new one is on the disk, so that no row is lost if the process is killed.

    Args:
        day: Folder of a day.

    Raises:
        OSError: The file cannot be written.
    """
    files = complete_files(day)
    path = day / f"{MERGED_PREFIX}{uuid.uuid4().hex}.parquet"
    unfinished = unfinished_name(path)
    names = [str(file) for file in files]
    with duckdb.connect(config={"memory_limit": MERGE_MEMORY, "temp_directory": str(day / ".sorting")}) as database:
        stored = database.read_parquet(names, union_by_name=True, hive_partitioning=False)  # noqa: F841 - used in SQL
        no_rows = SCHEMA.empty_table()  # noqa: F841 - because files of older versions lack columns
        database.sql("SELECT * FROM no_rows UNION ALL BY NAME SELECT * FROM stored").create_view("rows")
        database.sql(f"{VALID_ROWS} ORDER BY pack, hour").write_parquet(
            str(unfinished), compression="zstd", row_group_size=ROW_GROUP
        )
    finish(unfinished, path)
    for file in files:
        file.unlink(missing_ok=True)
    return path


def remove_unfinished(folder: Path) -> None:
    """Remove unfinished files of a killed process. No other process may write to ``folder`` meanwhile."""
    for pattern in (f".*{UNFINISHED_SUFFIX}", f"{DAY_FOLDER_PREFIX}*/.*{UNFINISHED_SUFFIX}"):
        for file in folder.glob(pattern):
            file.unlink(missing_ok=True)


def complete_files(day: Path) -> list[Path]:
    """Return the complete files of a day, sorted by name."""
    return [file for file in sorted(day.glob("*.parquet")) if is_complete(file)]


def is_complete(file: Path) -> bool:
    """Return True if a file begins and ends like a Parquet file; False if it does not exist."""
    try:
        with file.open("rb") as opened:
            if opened.read(4) != _MAGIC:
                return False
            opened.seek(-4, os.SEEK_END)
            return opened.read(4) == _MAGIC
    except OSError:
        return False
