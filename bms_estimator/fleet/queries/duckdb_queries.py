"""Queries on the hourly rows of all packs: SQL on Parquet files by DuckDB. A collector may write at the same time.

Meaning, method and limits of each query are in docs/fleet/questions.md.
"""

import contextlib
import math
import re
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
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
    PACKS_FILE,
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
MAX_ROW_AGE_H = 3
"""Age of the newest row above which a note asks if workers and collector run [h]."""
EXPECTED_FALSE_REPORTS = 0.1
"""Expected number of packs of the fleet that are reported by chance, for each quantity."""
MIN_STDS = 3.0
"""Minimum deviation of a reported pack [standard deviations]. In a large fleet the limit is higher."""


class Query(NamedTuple):
    """Named query."""

    tables: tuple[str, ...]
    """Tables that the query uses; each is created by an SQL file of its name."""
    help: str
    """Description in the list of queries."""


QUERIES = {
    "soh": Query(("days", "packs", "points", "fits"), "capacity trend a year with its band, of each type and pack"),
    "outliers": Query(("days", "packs"), "packs whose capacity or R_s deviates from their type"),
    "failing": Query(
        ("days", "packs", "points", "fits"),
        "packs with a faulty cell, that will soon reach a limit, or that have recent input faults",
    ),
    "honest": Query(("days", "packs"), "how often the SOC was within 2 std, compared with later estimates"),
    "silent": Query(("days", "packs"), "packs of which nothing has arrived recently, or ever"),
    "clocks": Query(("server_errors",), "wrong clocks of edges, whose hours may be quarantined, and of the server"),
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
    """Queries soh, failing: minimum number of days in a trend."""
    min_packs: int = 5
    """Query outliers: minimum number of packs with a valid value that define the reference of their type."""
    min_spread: float = 0.01
    """Query outliers: lower bound of the relative standard deviation between packs of a type."""
    recent_days: int = 3
    """Query failing: number of most recent days. A pack is reported if more than half of the days have a new input fault, and
    a cell if it is faulty in more than half of the hours of these days."""
    weak_cell_soc: float = 0.03
    """Query failing: minimum deviation of a cell's SOC below the mean of the cells, after subtraction of three std."""
    small_cell_ratio: float = 0.9
    """Query failing: upper limit of the capacity of a cell, relative to the median of the cells."""
    resistive_cell_ratio: float = 1.25
    """Query failing: minimum resistance of a cell, relative to the median, after subtraction of two std."""
    self_discharge_c: float = MIN_SHORT_C
    """Query failing: minimum self-discharge of a cell above the median cell, as a C-rate [1/h]."""
    silent_hours: int = 2
    """Query silent: maximum time since the last summary arrived [h]. The summary of an hour arrives in the next hour."""
    min_server_packs: int = 3
    """Query clocks: minimum number of packs with a clock error in one hour that proves a wrong clock of the server."""
    behind_h: int = 24
    """Query clocks: minimum time by which an edge's clock is constantly behind the server's [h]."""
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
    notes: tuple[str, ...] = ()
    """Warnings, for example of a wrong clock."""

    @property
    def records(self) -> list[dict[str, Any]]:
        """Rows as dictionaries by column."""
        return [dict(zip(self.columns, row, strict=True)) for row in self.rows]


def run_query(
    folder: Path,
    name: str,
    *,
    days: int | None = None,
    limits: Limits = LIMITS,
    wall: Callable[[], float] = time.time,
) -> Answer:
    """Run a named query.

    Args:
        folder: Folder of the Parquet files, written by ``fleet collect``.
        name: Name in ``QUERIES``.
        days: Number of last days (UTC) that are used; None: all.
        limits: Parameters of the query.
        wall: Wall clock of this machine [s since 1970].

    Raises:
        UserError: The query, the folder or its rows do not exist, or a file is damaged.
    """
    if name not in QUERIES:
        raise UserError(f"{name}: no such query; there are {', '.join(QUERIES)}, and sql 'SELECT ...'")
    with open_database(folder, days, wall=wall) as (database, present):
        parameters = vars(limits) | _parameters(present)
        for table in QUERIES[name].tables:
            _run(database, _sql(table), parameters)
            if table == "packs":  # the limit depends on the number of packs
                parameters["stds"] = _reporting_limit_stds(database)
        answer = _answer(_run(database, _sql(name), parameters), present.notes)
        if name == "soh" and not answer.rows:
            measured_days = "SELECT count(DISTINCT pack), coalesce(max(n), 0) FROM (SELECT pack, count(*) AS n FROM points WHERE quantity = 'capacity' GROUP BY pack)"
            ((packs, most),) = database.execute(measured_days).fetchall()
            text = (
                f"no trend yet: it needs {limits.min_days} days on which the capacity of a pack was measured, by a large change of its SOC; "
                f"so far {packs} packs have such days, at most {most}"
            )
            answer = replace(answer, notes=(*answer.notes, text))
        return answer


def select(folder: Path, query: str, *, days: int | None = None) -> Answer:
    """Run an SQL query on the view ``hours``, without write access and without access to other files.

    Raises:
        UserError: The folder or its rows do not exist, a file is damaged, or the query is invalid.
    """
    with open_database(folder, days) as (database, present):
        database.execute("SET allowed_directories = $folders", {"folders": [str(folder)]})
        database.execute("SET enable_external_access = false")
        database.execute("SET lock_configuration = true")
        try:
            if any(each.type not in READ_ONLY_STATEMENTS for each in database.extract_statements(query)):
                raise UserError("sql: only SELECT and DESCRIBE are allowed")
            return _answer(database.execute(query), present.notes)
        except duckdb.Error as error:
            raise UserError(f"sql: {error}") from error


def server_errors(folder: Path, *, wall: Callable[[], float]) -> tuple[list[int], int]:
    """Return the hours in which rows arrived while the server's clock was wrong, and the present hour [hours since 1970].

    Args:
        folder: Folder of the Parquet files.
        wall: Wall clock of this machine [s since 1970].

    Raises:
        UserError: The folder does not exist, is empty, or has a damaged file.
    """
    with open_database(folder, wall=wall) as (database, present):
        _run(database, _sql("server_errors"), vars(LIMITS) | _parameters(present))
        rows = database.execute("SELECT received_hour FROM server_errors").fetchall()
        return [hour for (hour,) in rows], present.present_hour


class Present(NamedTuple):
    """Present time of the queries."""

    present_hour: int
    """Present hour of this machine, or of the servers if this machine's clock is behind [hours since 1970]."""
    now_hour: int
    """Last complete hour on the server's clock when the newest row arrived [hours since 1970]."""
    notes: tuple[str, ...] = ()
    """Warnings about wrong clocks and outdated rows."""


@contextlib.contextmanager
def open_database(
    folder: Path, days: int | None = None, *, wall: Callable[[], float] = time.time
) -> Iterator[tuple[duckdb.DuckDBPyConnection, Present]]:
    """Open a database with the view ``hours``, which has one row for each hour of each pack, and the view ``quarantined``.

    The days end with ``Present.now_hour``.

    Args:
        folder: Folder of the Parquet files.
        days: Number of last days (UTC) that are used; None: all.
        wall: Wall clock of this machine [s since 1970].

    Raises:
        UserError: The folder does not exist, is empty, or has a damaged file.
    """
    files, quarantined = _files(folder), _files_by_day(folder / QUARANTINE_FOLDER)
    with duckdb.connect() as database, _user_errors(folder):
        database.execute("SET TimeZone = 'UTC'")
        names = [str(file) for day_files in (*files.values(), *quarantined.values()) for file in day_files]
        present = find_present(database, names, int(wall() // HOUR_S))
        database.execute(f"SET VARIABLE now_hour = {present.now_hour}")
        last = _day_name(present.now_hour + 1)
        first = "" if days is None else _day_name(present.now_hour - 24 * (days - 1))
        valid_files = {day: files for day, files in files.items() if first <= day.name <= last}
        _create_hours_view(database, valid_files)
        # also later days, at which rows arrived while the server's clock was ahead
        late = [str(file) for day, day_files in quarantined.items() if first <= day.name for file in day_files]
        _read_files(database, late).create_view("quarantined")
        _create_listed_packs(database, folder)
        yield database, present


@contextlib.contextmanager
def _user_errors(folder: Path) -> Iterator[None]:
    """Convert errors of damaged or replaced files to ``UserError``."""
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


def find_present(database: duckdb.DuckDBPyConnection, names: list[str], wall_hour: int) -> Present:
    """Return the present time. Usually only the statistics in the files are read.

    A row that arrived after the present on the server's clock shows that a clock is wrong. It is this machine's clock if the
    clocks of most edges are later, too; otherwise it is the server's, and the row's arrival is not used.

    Args:
        database: Database.
        names: Files.
        wall_hour: Present hour on this machine's clock [hours since 1970].
    """
    statistics = """
        SELECT max(latest) FILTER (path_in_schema = 'received_hour'),
            max(latest) FILTER (path_in_schema = 'hour' AND latest <= $wall_hour)
        FROM (SELECT path_in_schema, stats_max_value::BIGINT AS latest FROM parquet_metadata($names)
            WHERE path_in_schema IN ('hour', 'received_hour'))
    """
    ((received, hour),) = database.execute(statistics, {"names": names, "wall_hour": wall_hour}).fetchall()
    notes: tuple[str, ...] = ()
    if received is not None and received > wall_hour + 1:
        later = """
            WITH arrivals AS (
                SELECT
                    max(received_hour) FILTER (received_hour <= $limit) AS known, max(received_hour) AS last,
                    count(*) FILTER (received_hour > $limit) AS later,
                    bool_or(received_hour > $limit AND hour > $limit AND clock_error_s IS NULL) AS agrees
                FROM read_parquet($names, union_by_name = true, hive_partitioning = false) GROUP BY pack
            )
            SELECT max(known), sum(later), count(*) FILTER (later > 0), count(*) FILTER (agrees), quantile_disc(last, 0.5), max(last)
            FROM arrivals
        """
        arrivals = database.execute(later, {"names": names, "limit": wall_hour + 1}).fetchall()
        ((received, rows, packs, agreeing, median, latest),) = arrivals
        if 2 * agreeing > packs:
            text = f"the clock of this machine is {median - wall_hour} h behind those of the server and of {agreeing} edges: set it"
            return Present(median, median - 1, (text,))
        text = f"{rows} rows of {packs} packs arrived in the future by the server's clock, up to {_time(latest)}: this arrival is not used"
        notes = (
            f"{text}; set the clocks of its nodes; `fleet ask clocks` lists the hours, `fleet repair` repairs the files",
        )
    now_hour = next((int(each) for each in (received and received - 1, hour) if each is not None), wall_hour)
    if wall_hour - now_hour > MAX_ROW_AGE_H:
        notes += (f"the newest row arrived at {_time(now_hour + 1)}: do workers and `fleet collect` run?",)
    return Present(wall_hour, now_hour, notes)


def _time(hour: int) -> str:
    return f"{datetime.fromtimestamp(hour * HOUR_S, UTC):%Y-%m-%d %H:%M} UTC"


def _day_name(hour: int) -> str:
    """Return the name of the folder of an hour's day."""
    return day_folder(Path(), datetime.fromtimestamp(hour * HOUR_S, UTC).date()).name


def _read_files(database: duckdb.DuckDBPyConnection, names: list[str]) -> duckdb.DuckDBPyRelation:
    """Return the rows of files; without files, a relation without rows."""
    if not names:
        return database.table("all_columns")
    return database.read_parquet(names, union_by_name=True, hive_partitioning=False)


def _create_listed_packs(database: duckdb.DuckDBPyConnection, folder: Path) -> None:
    """Create the view ``listed`` of the packs in the table that the collector has stored; empty without a stored table."""
    file = folder / PACKS_FILE
    if file.exists():
        database.read_parquet(str(file)).create_view("listed")
    else:
        database.execute("CREATE TEMP VIEW listed AS SELECT ''::VARCHAR AS pack, 0::BIGINT AS listed_hour WHERE false")


def _create_hours_view(database: duckdb.DuckDBPyConnection, files: Mapping[Path, list[Path]]) -> None:
    """Create the view ``hours``. Only unmerged files can have several rows of one hour.

    Raises:
        UserError: The files have other columns.
    """
    merged, unmerged = list[str](), list[str]()
    for day_files in files.values():
        is_merged = len(day_files) == 1 and day_files[0].name.startswith(MERGED_PREFIX)
        (merged if is_merged else unmerged).extend(str(file) for file in day_files)
    database.register("all_columns", SCHEMA.empty_table())  # because files of other versions may lack some columns
    for name, paths in (("merged_rows", merged), ("unmerged_rows", unmerged)):
        read = _read_files(database, paths)
        if not {"pack", "hour"} <= set(read.columns):
            raise UserError(
                f"{Path(paths[0]).parent}: its files lack the columns pack and hour: they are not from `fleet collect`"
            )
        read.create_view(name)
    database.execute("CREATE TEMP VIEW rows AS SELECT * FROM all_columns UNION ALL BY NAME SELECT * FROM unmerged_rows")
    database.execute("CREATE TEMP VIEW stored AS SELECT * FROM rows UNION ALL BY NAME SELECT * FROM merged_rows")
    database.execute(f"CREATE TEMP VIEW valid_rows AS {VALID_ROWS}")
    database.execute(_sql("hours"))


def _parameters(present: Present) -> dict[str, Any]:
    return {
        "present_hour": present.present_hour,
        "now_hour": present.now_hour,
        "today": present.now_hour // 24,
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


def _answer(result: duckdb.DuckDBPyConnection, notes: tuple[str, ...]) -> Answer:
    columns = tuple(column[0] for column in result.description or ())
    return Answer(columns, [tuple(_plain(value) for value in row) for row in result.fetchall()], notes)


def _plain(value: Any) -> Any:
    if isinstance(value, datetime):
        return value.replace(tzinfo=UTC).isoformat().replace("+00:00", "Z")
    return None if isinstance(value, float) and not math.isfinite(value) else value
