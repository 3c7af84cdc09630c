"""Erasure of packs from the Parquet files, and repair of rows that arrived while the server's clock was wrong.

No collector may run meanwhile.
"""

import time
from collections.abc import Callable, Collection, Mapping
from pathlib import Path

import duckdb
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from bms_estimator.fleet.queries.duckdb_queries import server_errors
from bms_estimator.fleet.queries.parquet_files import (
    DAY_FOLDER_PREFIX,
    MERGE_MEMORY,
    PACKS_FILE,
    QUARANTINE_FOLDER,
    ROW_GROUP,
    SCHEMA,
    complete_files,
    finish,
    unfinished_name,
    write_table,
)

MAX_BEHIND_H = 366 * 24
"""Maximum age of a plausible hour [h], as ``worker.block_order.MAX_BEHIND_S``."""


def erase_rows(folder: Path, packs: Collection[str]) -> int:
    """Remove all rows of packs from the files, also from those in quarantine. Return the number of rows.

    Args:
        folder: Folder of the Parquet files.
        packs: Names of the packs.

    Raises:
        OSError: A file cannot be written. This file is unchanged, and a repeated call continues with it.
    """
    (folder / PACKS_FILE).unlink(missing_ok=True)  # the collector writes it again
    parameters = {"packs": list(packs)}
    return sum(_remove_rows(file, "pack IN (SELECT unnest($packs))", parameters) for file in _all_files(folder))


def repair_arrivals(folder: Path, *, wall: Callable[[], float] = time.time) -> int:
    """Repair the rows that arrived while the server's clock was wrong. Return their number.

    Their arrival becomes unknown, and they are moved out of quarantine. Rows whose hour is implausible by this machine's clock
    are not changed.

    Args:
        folder: Folder of the Parquet files.
        wall: Wall clock of this machine [s since 1970].

    Raises:
        UserError: The folder does not exist, is empty, or has a damaged file.
        OSError: A file cannot be written. A repeated call continues with it.
    """
    wrong_hours, present_hour = server_errors(folder, wall=wall)
    parameters = {"wrong": wrong_hours, "first": present_hour - MAX_BEHIND_H, "last": present_hour}
    is_wrong = pc.field("received_hour").isin(wrong_hours)
    is_plausible = (pc.field("hour") >= parameters["first"]) & (pc.field("hour") <= parameters["last"])
    count = 0
    for file in _all_files(folder) if wrong_hours else ():
        if "received_hour" not in pq.read_schema(file).names:  # of an older version
            continue
        rows = pq.read_table(file, filters=is_wrong & is_plausible, partitioning=None)
        for name in ("received_hour", "clock_error_s"):
            rows = rows.set_column(
                rows.schema.get_field_index(name), SCHEMA.field(name), pa.nulls(len(rows), SCHEMA.field(name).type)
            )
        write_table(folder, rows)  # if the process is killed now, queries use one of the equal rows
        condition = "received_hour IN (SELECT unnest($wrong)) AND hour BETWEEN $first AND $last"
        count += _remove_rows(file, condition, parameters)
    return count


def _all_files(folder: Path) -> list[Path]:
    """Return the files of all days, also those in quarantine."""
    days = [day for root in (folder, folder / QUARANTINE_FOLDER) for day in sorted(root.glob(f"{DAY_FOLDER_PREFIX}*"))]
    return [file for day in days for file in complete_files(day)]


def _remove_rows(file: Path, condition: str, parameters: Mapping[str, object]) -> int:
    """Replace a file by one without the rows of an SQL condition, or remove it if no row remains. Return the number of rows."""
    with duckdb.connect(config={"memory_limit": MERGE_MEMORY}) as database:
        database.read_parquet(str(file), hive_partitioning=False).create_view("rows")
        # fetchall: an open result blocks the connection
        counts = f"SELECT count(*), count(*) FILTER ({condition}) FROM rows"  # noqa: S608 - constant text
        ((total, removed),) = database.execute(counts, parameters).fetchall()
        if not removed:
            return 0
        if removed == total:
            file.unlink()
            return int(removed)
        unfinished = unfinished_name(file)
        query = f"SELECT * FROM rows WHERE ({condition}) IS NOT TRUE"  # noqa: S608 - constant text
        others = database.sql(query, params=parameters)
        others.write_parquet(str(unfinished), compression="zstd", row_group_size=ROW_GROUP)
    finish(unfinished, file)
    return int(removed)
