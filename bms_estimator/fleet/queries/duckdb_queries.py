"""Queries on the hourly rows of all packs: SQL on Parquet files by DuckDB. A collector may write at the same time.

Meaning, method and limits of each query are in docs/fleet/questions.md.
"""

import contextlib
import math
import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import resources
from pathlib import Path
from statistics import NormalDist
from typing import Any, NamedTuple

import duckdb

from bms_estimator.fleet.hour_row import HOUR_S
from bms_estimator.fleet.queries.parquet_files import (
    DAY_FOLDER_PREFIX,
    MERGED_PREFIX,
    QUARANTINE_FOLDER,
    SCHEMA,
    VALID_ROWS,
    day_folder,
    is_complete,
)
from bms_estimator.model.errors import UserError
from bms_estimator.model.input_faults import InputFault
from bms_estimator.settings.alarm_limits import MIN_SHORT_C

SQL = resources.files("bms_estimator.fleet.queries") / "sql"
AGED_SOC = 1000.0
"""Charge after which the filter forgets the capacity [capacities], as in ``kernels.kalman_filter.records.Noise``."""
CHARGE_ERROR = 0.002
"""Standard deviation of the counted charge in the filter [sqrt(capacities)], as in
``kernels.kalman_filter.records.Noise``."""
READ_ONLY_STATEMENTS = (duckdb.StatementType.SELECT, duckdb.StatementType.EXPLAIN)
"""Types of statements that a user's SQL query may contain."""
EXPECTED_FALSE_REPORTS = 0.1
"""Expected number of packs of the fleet that are reported by chance, for each quantity."""
MIN_STDS = 3.0
"""Minimum deviation of a reported pack, which applies in a small fleet [standard deviations]."""


class Query(NamedTuple):
    """Named query."""

    tables: tuple[str, ...]
    """Tables that the query uses; each is created by an SQL file of its name."""
    help: str
    """Description in the list of queries."""


QUERIES = {
    "soh": Query(("days", "packs", "fits"), "capacity trend a year with its band, of each type and pack"),
    "outliers": Query(("days", "packs"), "packs whose capacity or R_s deviates from their type"),
    "failing": Query(("days", "packs", "fits"), "packs that will soon reach a limit, or have recent input faults"),
    "honest": Query(("days", "packs"), "how often the SOC was within 2 std, compared with later estimates"),
    "silent": Query(("days", "packs"), "packs without recent hours"),
    "weak-cells": Query(("days", "packs"), "packs in which one series cell is below the others in most recent hours"),
    "imbalance": Query(("days", "packs"), "packs whose cells differ in SOC, and the trend of the difference"),
    "self-discharge": Query(
        ("days", "packs"), "cells that discharge themselves, for example by an internal short, with their current"
    ),
    "clocks": Query((), "packs whose edge's clock is wrong, so that their hours are quarantined"),
}


@dataclass(frozen=True)
class Limits:
    """Parameters of the queries."""

    within_days: float = 90.0
    """Query failing: maximum time until a limit is reached [days]."""
    capacity_limit: float = 0.8
    """Query failing: lower limit of the capacity as a fraction of the rated capacity."""
    r_s_limit: float = 2.0
    """Query failing: upper limit of the ratio of R_s to the cell file's R_s."""
    r_s_fresh_s: float = 86_400.0
    """Maximum time since R_s was last identified [s]; older values are not used."""
    min_days: int = 7
    """Queries soh, failing, imbalance: minimum number of days in a trend."""
    min_packs: int = 5
    """Query outliers: minimum number of packs with a valid value that define the reference of their type."""
    min_spread: float = 0.01
    """Query outliers: lower bound of the relative standard deviation between packs of a type."""
    recent_days: int = 3
    """Query failing: number of most recent days. A pack is reported if more than half of them have a new input fault.
    Queries weak-cells, imbalance and self-discharge use the rows of these days."""
    weak_cell_soc: float = 0.05
    """Query weak-cells: minimum mean deviation of the weakest cell below the mean of the cells [SOC]."""
    imbalance_soc: float = 0.05
    """Query imbalance: minimum difference between the highest and the lowest cell [SOC]."""
    self_discharge_c: float = MIN_SHORT_C
    """Query self-discharge: minimum self-discharge of a cell above the median cell, as a C-rate [1/h]."""
    silent_hours: int = 2
    """Query silent: maximum age of the last summary [h]. The newest summary of a live pack is of the previous hour."""
    max_packs: int = 10_000
    """Query honest: maximum number of packs, selected by a hash of their name."""
    min_seen_s: float = 3590.0
    """Query honest: minimum measured part of each hour between an estimate and its reference [s]."""
    max_variance_ratio: float = 0.5
    """Query honest: maximum variance of the reference, a later estimate, as a fraction of the variance of the estimate."""


LIMITS = Limits()


@dataclass(frozen=True)
class Answer:
    """Result table; unknown values are None."""

    columns: tuple[str, ...]
    rows: list[tuple[Any, ...]]

    @property
    def records(self) -> list[dict[str, Any]]:
        """Rows as dictionaries by column."""
        return [dict(zip(self.columns, row, strict=True)) for row in self.rows]


def run_query(folder: Path, name: str, *, days: int | None = None, limits: Limits = LIMITS) -> Answer:
    """Run a named query.

    Args:
        folder: Folder of the Parquet files, written by ``fleet collect``.
        name: Name in ``QUERIES``.
        days: Number of last days (UTC) that are used; None: all.
        limits: Parameters of the query.

    Raises:
        UserError: The query, the folder or its rows do not exist, or a file is damaged.
    """
    if name not in QUERIES:
        raise UserError(f"{name}: no such query; there are {', '.join(QUERIES)}, and sql 'SELECT ...'")
    with open_database(folder, days) as database:
        (now_hour,) = database.execute("SELECT getvariable('now_hour')").fetchone() or (0,)
        parameters = vars(limits) | _parameters(int(now_hour))
        for table in QUERIES[name].tables:
            _run(database, _sql(table), parameters)
            if table == "packs":  # the limit depends on the number of packs
                parameters["stds"] = _reporting_limit_stds(database)
        return _answer(_run(database, _sql(name), parameters))


def select(folder: Path, query: str, *, days: int | None = None) -> Answer:
    """Run an SQL query on the view ``hours``, without write access and without access to other files.

    Raises:
        UserError: The folder or its rows do not exist, a file is damaged, or the query is invalid.
    """
    with open_database(folder, days) as database:
        database.execute("SET allowed_directories = $folders", {"folders": [str(folder)]})
        database.execute("SET enable_external_access = false")
        database.execute("SET lock_configuration = true")
        try:
            if any(each.type not in READ_ONLY_STATEMENTS for each in database.extract_statements(query)):
                raise UserError("sql: only SELECT and DESCRIBE are allowed")
            return _answer(database.execute(query))
        except duckdb.Error as error:
            raise UserError(f"sql: {error}") from error


@contextlib.contextmanager
def open_database(
    folder: Path, days: int | None = None, *, wall: Callable[[], float] = time.time
) -> Iterator[duckdb.DuckDBPyConnection]:
    """Open a database with the view ``hours``, which has one row for each hour of each pack, and the view ``quarantined``.

    The variable ``now_hour`` is the last complete hour on the server's clock when the newest row arrived. The days end with
    this hour.

    Args:
        folder: Folder of the Parquet files.
        days: Number of last days (UTC) that are used; None: all.
        wall: Wall clock [s since 1970], used only if all rows are from workers that did not record the server's time.

    Raises:
        UserError: The folder does not exist, is empty, or has a damaged file.
    """
    files, quarantined = _files(folder), _files_by_day(folder / QUARANTINE_FOLDER)
    with duckdb.connect() as database, _user_errors(folder):
        database.execute("SET TimeZone = 'UTC'")
        now_hour = _present_hour(database, [*files.values(), *quarantined.values()], int(wall() // HOUR_S))
        database.execute(f"SET VARIABLE now_hour = {now_hour}")
        _create_hours_view(database, _last_days(files, now_hour, days))
        _create_quarantined_view(database, _last_days(quarantined, now_hour, days))
        yield database


@contextlib.contextmanager
def _user_errors(folder: Path) -> Iterator[None]:
    """Raise errors of damaged or replaced files as ``UserError``."""
    try:
        yield
    except (duckdb.InvalidInputException, duckdb.IOException) as error:
        raise UserError(
            f"--folder {folder}: a file cannot be read; repeat the query, or move the file away: {error}"
        ) from error


def _files(folder: Path) -> dict[Path, list[Path]]:
    """Return the files by day folder.

    Raises:
        UserError: There is no file, or one is incomplete.
    """
    if not folder.is_dir():
        raise UserError(f"--folder {folder}: no such folder; `bms-estimator fleet collect --folder {folder}` fills it")
    by_day = _files_by_day(folder)
    if not by_day and not _files_by_day(folder / QUARANTINE_FOLDER):
        raise UserError(f"--folder {folder}: no hours yet: the first one of a pack is written when its next one begins")
    for file in (file for files in by_day.values() for file in files):
        if file.exists() and not is_complete(file):
            raise UserError(f"{file}: an incomplete Parquet file; move it away: its rows are lost")
    return by_day


def _files_by_day(folder: Path) -> dict[Path, list[Path]]:
    by_day = {day: sorted(day.glob("*.parquet")) for day in sorted(folder.glob(f"{DAY_FOLDER_PREFIX}*"))}
    return {day: files for day, files in by_day.items() if files}


def _present_hour(database: duckdb.DuckDBPyConnection, files: Iterable[list[Path]], wall_hour: int) -> int:
    """Return the last complete hour on the server's clock when the newest row arrived.

    If no row has the server's time, return the newest hour of a row that is not after ``wall_hour``, or ``wall_hour`` without
    such a row. Only the statistics in the files are read.
    """
    names = [str(file) for day_files in files for file in day_files]
    statistics = """
        SELECT max(latest) FILTER (path_in_schema = 'received_hour') - 1,
            max(latest) FILTER (path_in_schema = 'hour' AND latest <= $wall_hour)
        FROM (SELECT path_in_schema, stats_max_value::BIGINT AS latest FROM parquet_metadata($names)
            WHERE path_in_schema IN ('hour', 'received_hour'))
    """
    found = database.execute(statistics, {"names": names, "wall_hour": wall_hour}).fetchone() or ()
    return next((int(hour) for hour in found if hour is not None), wall_hour)


def _last_days(by_day: Mapping[Path, list[Path]], now_hour: int, days: int | None) -> dict[Path, list[Path]]:
    """Return the files of the days up to the hour after ``now_hour``: of the last ``days`` days, or of all days without this limit."""
    last = _day_name(now_hour + 1)
    first = "" if days is None else _day_name(now_hour - 24 * (days - 1))
    return {day: files for day, files in by_day.items() if first <= day.name <= last}


def _day_name(hour: int) -> str:
    """Return the name of the folder of an hour's day."""
    return day_folder(Path(), datetime.fromtimestamp(hour * HOUR_S, UTC).date()).name


def _create_quarantined_view(database: duckdb.DuckDBPyConnection, files: Mapping[Path, list[Path]]) -> None:
    """Create the view ``quarantined`` with the rows of packs with a wrong clock."""
    names = [str(file) for day_files in files.values() for file in day_files]
    read = database.read_parquet(names, union_by_name=True, hive_partitioning=False) if names else None
    (database.table("all_columns") if read is None else read).create_view("quarantined")


def _create_hours_view(database: duckdb.DuckDBPyConnection, files: Mapping[Path, list[Path]]) -> None:
    """Create the view ``hours``. Only days with files that were not merged can have several rows of one hour.

    Raises:
        UserError: The files have other columns.
    """
    merged, unmerged = list[str](), list[str]()
    for day_files in files.values():
        is_merged = len(day_files) == 1 and day_files[0].name.startswith(MERGED_PREFIX)
        (merged if is_merged else unmerged).extend(str(file) for file in day_files)
    database.register("all_columns", SCHEMA.empty_table())  # because files of other versions may lack some columns
    for name, paths in (("merged_rows", merged), ("unmerged_rows", unmerged)):
        read = database.read_parquet(paths, union_by_name=True, hive_partitioning=False) if paths else None
        if read is not None and not {"pack", "hour"} <= set(read.columns):
            raise UserError(
                f"{Path(paths[0]).parent}: its files lack the columns pack and hour: they are not from `fleet collect`"
            )
        (database.table("all_columns") if read is None else read).create_view(name)
    database.execute("CREATE TEMP VIEW rows AS SELECT * FROM all_columns UNION ALL BY NAME SELECT * FROM unmerged_rows")
    database.execute(f"CREATE TEMP VIEW valid_rows AS {VALID_ROWS}")
    database.execute(_sql("hours"))


def _parameters(now_hour: int) -> dict[str, Any]:
    return {
        "now_hour": now_hour,
        "today": now_hour // 24,
        "aged_soc": AGED_SOC,
        "charge_error": CHARGE_ERROR,
        "suspect_bits": [int(suspect) for suspect in InputFault],
        "suspect_names": [str(suspect.name).lower().replace("_", " ") for suspect in InputFault],
    }


def _reporting_limit_stds(database: duckdb.DuckDBPyConnection) -> float:
    """Return the deviation that ``EXPECTED_FALSE_REPORTS`` packs exceed by chance [standard deviations]."""
    (packs,) = database.execute("SELECT count(*) FROM packs").fetchone() or (0,)
    return max(NormalDist().inv_cdf(1.0 - 0.5 * EXPECTED_FALSE_REPORTS / max(packs, 1)), MIN_STDS)


def _sql(name: str) -> str:
    return (SQL / f"{name.replace('-', '_')}.sql").read_text(encoding="utf-8")


def _run(database: duckdb.DuckDBPyConnection, query: str, parameters: Mapping[str, Any]) -> duckdb.DuckDBPyConnection:
    """Run a query with the parameters that it names."""
    return database.execute(query, {name: parameters[name] for name in set(re.findall(r"\$(\w+)", query))})


def _answer(result: duckdb.DuckDBPyConnection) -> Answer:
    columns = tuple(column[0] for column in result.description or ())
    return Answer(columns, [tuple(_plain(value) for value in row) for row in result.fetchall()])


def _plain(value: Any) -> Any:
    if isinstance(value, datetime):
        return value.replace(tzinfo=UTC).isoformat().replace("+00:00", "Z")
    return None if isinstance(value, float) and not math.isfinite(value) else value
