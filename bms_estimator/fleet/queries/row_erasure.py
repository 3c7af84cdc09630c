"""Erasure of packs from the Parquet files. No collector may run meanwhile."""

from collections.abc import Collection
from pathlib import Path

import duckdb

from bms_estimator.fleet.queries.parquet_files import (
    DAY_FOLDER_PREFIX,
    MERGE_MEMORY,
    QUARANTINE_FOLDER,
    ROW_GROUP,
    complete_files,
    finish,
    unfinished_name,
)


def erase_rows(folder: Path, packs: Collection[str]) -> int:
    """Remove all rows of packs from the files, also from those in quarantine. Return the number of rows.

    Args:
        folder: Folder of the Parquet files.
        packs: Names of the packs.

    Raises:
        OSError: A file cannot be written. This file is unchanged, and a repeated call continues with it.
    """
    days = [day for root in (folder, folder / QUARANTINE_FOLDER) for day in sorted(root.glob(f"{DAY_FOLDER_PREFIX}*"))]
    return sum(_erase_from_file(file, packs) for day in days for file in complete_files(day))


def _erase_from_file(file: Path, packs: Collection[str]) -> int:
    """Replace a file by one without the rows of packs, or remove it if no row remains."""
    with duckdb.connect(config={"memory_limit": MERGE_MEMORY}) as database:
        rows = database.read_parquet(str(file), hive_partitioning=False)
        rows.create_view("rows")
        parameters = {"packs": list(packs)}
        counts = "SELECT count(*), count(*) FILTER (pack IN (SELECT unnest($packs))) FROM rows"
        # fetchall: an open result blocks the connection
        ((total, erased),) = database.execute(counts, parameters).fetchall()
        if not erased:
            return 0
        if erased == total:
            file.unlink()
            return int(erased)
        unfinished = unfinished_name(file)
        others = database.sql("SELECT * FROM rows WHERE pack NOT IN (SELECT unnest($packs))", params=parameters)
        others.write_parquet(str(unfinished), compression="zstd", row_group_size=ROW_GROUP)
    finish(unfinished, file)
    return int(erased)
