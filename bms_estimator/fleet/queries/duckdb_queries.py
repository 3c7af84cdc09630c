"""Questions to the hours of all packs: SQL on Parquet files, by DuckDB. Reads while a collector writes.

What each means, how it is computed and where it misleads: docs/fleet/questions.md.
"""

import contextlib
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import resources
from pathlib import Path
from statistics import NormalDist
from typing import Any, NamedTuple

import duckdb

from bms_estimator.fleet.hour_row import HOUR_S
from bms_estimator.fleet.queries.parquet_files import DAY, FOLDER, SCHEMA, day_folder, is_whole
from bms_estimator.model.errors import UserError
from bms_estimator.model.input_faults import InputFault

SQL = resources.files("bms_estimator.fleet.queries") / "sql"
AGED_SOC, CHARGE_ERROR = 1000.0, 0.002
"""Assumptions of the filter between two estimates, as in ``kernels.kalman_filter.records.Noise``."""
READING = (duckdb.StatementType.SELECT, duckdb.StatementType.EXPLAIN)
BY_CHANCE = 0.1
"""Expected number of packs of a whole fleet that are reported by chance, for each quantity."""
MIN_STDS = 3.0
"""Minimum deviation of a reported pack in std, for any size of fleet."""


class Query(NamedTuple):
    """Query with a name."""

    needs: tuple[str, ...]
    """Tables to be made before, files of SQL."""
    help: str


QUESTIONS = {
    "soh": Query(("days", "packs", "fits"), "capacity by the year with its band, of each type and pack"),
    "outliers": Query(("days", "packs"), "packs whose capacity or R_s is not as that of their type"),
    "failing": Query(("days", "packs", "fits"), "packs that reach a limit soon, or that are suspected of late"),
    "honest": Query(("days", "packs"), "how often the SOC was within 2 std, judged in hindsight"),
    "silent": Query(("days", "packs"), "packs that stopped"),
}


@dataclass(frozen=True)
class Limits:
    """Parameters of the queries."""

    within_days: float = 90.0
    """failing: a limit is reached so soon."""
    capacity_limit: float = 0.8
    """failing: of the declared capacity."""
    r_s_limit: float = 2.0
    """failing: times that of the cell file."""
    r_s_fresh_s: float = 86_400.0
    """Maximum age of the data behind a used R_s [s]."""
    least_days: int = 7
    """Queries soh, failing: minimum number of days in a trend."""
    least_packs: int = 5
    """Query outliers: minimum number of certain packs that define the reference of their type."""
    least_spread: float = 0.01
    """Query outliers: minimum relative std between packs of a type."""
    recent_days: int = 3
    """Query failing: number of last days, most of which must have a new suspicion."""
    silent_hours: int = 2
    """silent: no summary for longer; a living pack's newest is of the hour before."""
    most_packs: int = 10_000
    """Query honest: maximum number of packs, chosen by a hash of their name."""
    least_seen_s: float = 3590.0
    """Query honest: minimum measured part of each hour in between [s]."""
    surer: float = 0.5
    """honest: a later estimate judges where its variance is below this part."""


LIMITS = Limits()


@dataclass(frozen=True)
class Answer:
    """Result table; numbers are plain, unknown values are None."""

    columns: tuple[str, ...]
    rows: list[tuple[Any, ...]]

    @property
    def records(self) -> list[dict[str, Any]]:
        """Row by row, by column."""
        return [dict(zip(self.columns, row, strict=True)) for row in self.rows]


def run_query(folder: Path, name: str, *, days: int | None = None, limits: Limits = LIMITS) -> Answer:
    """Answer one of ``QUESTIONS``.

    Args:
        folder: Folder of the days, as ``fleet collect`` writes it.
        name: Name of the question.
        days: Number of last days with rows, whole days UTC; None: all.
        limits: Assumed limits.

    Raises:
        UserError: There is no such question, folder or row; a file is damaged.
    """
    if name not in QUESTIONS:
        raise UserError(f"{name}: no such question; there are {', '.join(QUESTIONS)}, and sql 'SELECT ...'")
    with opened(folder, days) as base:
        (now_hour,) = base.execute("SELECT max(hour) FROM hours").fetchone() or (None,)
        if now_hour is None:
            raise UserError(f"--folder {folder}: its files hold no rows yet")
        given = vars(limits) | _given(int(now_hour))
        for table in QUESTIONS[name].needs:
            _run(base, _sql(table), given)
            if table == "packs":
                given["stds"] = _stds(base)
        return _answer(_run(base, _sql(name), given))


def select(folder: Path, query: str, *, days: int | None = None) -> Answer:
    """Answer a query of SQL on the view ``hours``; it changes nothing and reads no other file.

    Raises:
        UserError: There is no such folder or row; a file is damaged; the query is wrong.
    """
    with opened(folder, days) as base:
        base.execute("SET allowed_directories = $folders", {"folders": [str(folder)]})
        base.execute("SET enable_external_access = false")
        base.execute("SET lock_configuration = true")
        try:
            if any(each.type not in READING for each in base.extract_statements(query)):
                raise UserError("sql: only SELECT and DESCRIBE are answered")
            return _answer(base.execute(query))
        except duckdb.Error as error:
            raise UserError(f"sql: {error}") from error


@contextlib.contextmanager
def opened(folder: Path, days: int | None = None) -> Iterator[duckdb.DuckDBPyConnection]:
    """Open a database with the view ``hours``: one row for each hour of each pack.

    Raises:
        UserError: There is no such folder, no file in it, or one that is damaged.
    """
    files = _files(folder, days)
    with duckdb.connect() as base, _damage(folder):
        base.execute("SET TimeZone = 'UTC'")
        _view(base, files)
        yield base


@contextlib.contextmanager
def _damage(folder: Path) -> Iterator[None]:
    try:
        yield
    except (duckdb.InvalidInputException, duckdb.IOException) as error:
        raise UserError(f"--folder {folder}: a file cannot be read; ask again, or move it away: {error}") from error


def _files(folder: Path, days: int | None) -> dict[Path, list[Path]]:
    """Return the files by day folder; ``days``: of the last days only.

    Raises:
        UserError: There are none, or one is incomplete.
    """
    if not folder.is_dir():
        raise UserError(f"--folder {folder}: no such folder; `bms-estimator fleet collect --folder {folder}` fills it")
    found = {day: sorted(day.glob("*.parquet")) for day in sorted(folder.glob(f"{FOLDER}*"))}
    found = {day: files for day, files in found.items() if files}
    if days is not None and found:
        last = datetime.fromisoformat(max(found).name.removeprefix(FOLDER)).replace(tzinfo=UTC)
        first = day_folder(folder, datetime.fromtimestamp(last.timestamp() - (days - 1) * 24 * HOUR_S, UTC).date())
        found = {day: files for day, files in found.items() if day >= first}
    if not found:
        raise UserError(f"--folder {folder}: no hours of packs in it yet: a pack's first comes when its next begins")
    for file in (file for files in found.values() for file in files):
        if file.exists() and not is_whole(file):
            raise UserError(f"{file}: not a whole Parquet file; move it away: what it held comes from nowhere else")
    return found


def _view(base: duckdb.DuckDBPyConnection, files: Mapping[Path, list[Path]]) -> None:
    """Create the view ``hours``. A merged file has no duplicate rows, so that most files need no deduplication.

    Raises:
        UserError: The files hold something else.
    """
    once, maybe_twice = list[str](), list[str]()
    for of_day in files.values():
        alone = len(of_day) == 1 and of_day[0].name.startswith(DAY)
        (once if alone else maybe_twice).extend(str(file) for file in of_day)
    base.register("all_columns", SCHEMA.empty_table())  # files of other versions may lack some
    for name, paths in (("once", once), ("maybe_twice", maybe_twice)):
        read = base.read_parquet(paths, union_by_name=True, hive_partitioning=False) if paths else None
        if read is not None and not {"pack", "hour"} <= set(read.columns):
            raise UserError(
                f"{Path(paths[0]).parent}: its files have no columns pack and hour: `fleet collect` wrote them not"
            )
        (base.table("all_columns") if read is None else read).create_view(name)
    base.execute(_sql("hours"))


def _given(now_hour: int) -> dict[str, Any]:
    return {
        "now_hour": now_hour,
        "today": now_hour // 24,
        "aged_soc": AGED_SOC,
        "charge_error": CHARGE_ERROR,
        "suspect_bits": [int(suspect) for suspect in InputFault],
        "suspect_names": [str(suspect.name).lower().replace("_", " ") for suspect in InputFault],
    }


def _stds(base: duckdb.DuckDBPyConnection) -> float:
    """Return the deviation in std that hardly one of all packs exceeds by chance."""
    (packs,) = base.execute("SELECT count(*) FROM packs").fetchone() or (0,)
    return max(NormalDist().inv_cdf(1.0 - 0.5 * BY_CHANCE / max(packs, 1)), MIN_STDS)


def _sql(name: str) -> str:
    return (SQL / f"{name}.sql").read_text(encoding="utf-8")


def _run(base: duckdb.DuckDBPyConnection, query: str, given: Mapping[str, Any]) -> duckdb.DuckDBPyConnection:
    """Run the query with those of ``given`` that it names."""
    return base.execute(query, {name: given[name] for name in set(re.findall(r"\$(\w+)", query))})


def _answer(result: duckdb.DuckDBPyConnection) -> Answer:
    columns = tuple(column[0] for column in result.description or ())
    return Answer(columns, [tuple(_plain(value) for value in row) for row in result.fetchall()])


def _plain(value: Any) -> Any:
    if isinstance(value, datetime):
        return value.replace(tzinfo=UTC).isoformat().replace("+00:00", "Z")
    return None if isinstance(value, float) and not math.isfinite(value) else value
