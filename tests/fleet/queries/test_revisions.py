"""Repeated rows of one hour: the row with the largest revision is valid."""

import os
import re
import shutil
from pathlib import Path

import duckdb
import pyarrow.parquet as pq
import pytest

from bms_estimator.fleet.queries.duckdb_queries import select
from bms_estimator.fleet.queries.parquet_files import LATE_DELAY_S, compact, complete_files, days_to_compact, write
from tests.fleet.hour_rows import BEGIN, make_hour

DOCS = Path(__file__).parents[3] / "docs" / "fleet" / "questions.md"


@pytest.fixture
def folder(tmp_path):
    """Return a folder with three files that hold hour 3 of a pack; its valid row has an SOC of 0.75."""
    rows = [make_hour("a", BEGIN + n, revision=10 * n, soc=0.5) for n in range(5)]
    write(tmp_path, [make_hour("a", BEGIN + 3, revision=35, soc=0.75)])
    write(tmp_path, rows)
    write(tmp_path, [make_hour("a", BEGIN + 3, soc=0.25)])  # of an older worker, without a revision
    return tmp_path


def soc_by_hour(rows):
    return {hour - BEGIN: soc for hour, soc in rows}


def test_queries_use_the_row_with_the_largest_revision_in_any_file(tmp_path):
    (former,) = write(tmp_path, [make_hour("a", BEGIN + n, revision=10 * n, soc=0.5) for n in range(5)])
    (valid,) = write(tmp_path, [make_hour("a", BEGIN + 3, revision=35, soc=0.75)])
    for former_name, valid_name in (("batch-1", "batch-2"), ("batch-4", "batch-3")):
        former = former.rename(former.with_name(f"{former_name}.parquet"))
        valid = valid.rename(valid.with_name(f"{valid_name}.parquet"))
        rows = select(tmp_path, "SELECT hour, soc FROM hours").rows
        assert len(rows) == 5
        assert soc_by_hour(rows)[3] == 0.75


def test_merged_file_has_each_hour_once_with_its_largest_revision(folder):
    (day,) = folder.glob("date=*")
    rows = pq.read_table(compact(day), columns=["hour", "soc"]).to_pylist()
    assert len(rows) == 5
    assert soc_by_hour((row["hour"], row["soc"]) for row in rows)[3] == 0.75


def test_of_equal_revisions_the_row_with_more_samples_is_valid(tmp_path):
    files = [write(tmp_path, [make_hour("a", BEGIN, revision=1, samples=n)])[0] for n in (900, 3600)]
    for names in (("batch-1", "batch-2"), ("batch-4", "batch-3")):
        files = [file.rename(file.with_name(f"{name}.parquet")) for file, name in zip(files, names, strict=True)]
        assert select(tmp_path, "SELECT samples FROM hours").rows == [(3600,)]
    (day,) = tmp_path.glob("date=*")
    assert pq.read_table(compact(day), columns=["samples"]).to_pylist() == [{"samples": 3600}]


def test_rows_that_arrive_after_the_merge_of_their_day_are_merged_within_an_hour(folder):
    """Other readers of the files would otherwise read these hours twice until the day has many files."""
    (day,) = folder.glob("date=*")
    compact(day)
    (late,) = write(folder, [make_hour("a", BEGIN + 3, revision=36, soc=1.0)])
    written_s = 3600.0 * (BEGIN + 48)
    os.utime(late, (written_s, written_s))
    assert days_to_compact(folder, written_s + LATE_DELAY_S - 1.0) == []
    assert days_to_compact(folder, written_s + LATE_DELAY_S) == [day]
    compact(day)
    (file,) = complete_files(day)
    assert soc_by_hour((row["hour"], row["soc"]) for row in pq.read_table(file).to_pylist())[3] == 1.0


def test_two_merged_files_of_a_killed_collector_are_merged_at_once(folder):
    (day,) = folder.glob("date=*")
    file = compact(day)
    shutil.copy(file, day / "day-copy.parquet")
    assert days_to_compact(folder, 3600.0 * (BEGIN + 48)) == [day]


def test_documented_view_gives_other_readers_each_hour_once(folder):
    (statement,) = re.findall(r"CREATE VIEW.*?;", DOCS.read_text(), re.DOTALL)
    with duckdb.connect() as database:
        database.execute(statement.replace("hours/date=", f"{folder}/date="))
        rows = database.sql("SELECT hour, soc FROM valid_hours").fetchall()
    assert len(rows) == 5
    assert soc_by_hour(rows)[3] == 0.75
