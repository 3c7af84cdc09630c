"""Packs with a wrong clock: their hours are quarantined, and the other packs' queries use the server's time."""

import pytest

from bms_estimator.fleet.queries.duckdb_queries import run_query, select
from bms_estimator.fleet.queries.parquet_files import QUARANTINE_FOLDER, write
from tests.fleet.hour_rows import BEGIN, make_hour

YEAR_2040 = 613_600
"""An hour in the year 2040 [hours since 1970]."""
YEAR_1970 = 5
"""An hour in the year 1970 [hours since 1970]."""


def fleet_with_wrong_clocks():
    """Return the rows of three live packs: one with a correct clock, and one each in 2040 and 1970."""
    rows = []
    for n in range(30):
        arrival = {"revision": n + 1, "received_hour": BEGIN + n + 1}
        rows.append(make_hour("correct", BEGIN + n, **arrival))
        ahead_s, behind_s = 3600.0 * (YEAR_2040 - BEGIN), 3600.0 * (YEAR_1970 - BEGIN)
        rows.append(make_hour("ahead", YEAR_2040 + n, clock_error_s=ahead_s, **arrival))
        rows.append(make_hour("behind", YEAR_1970 + n, clock_error_s=behind_s, **arrival))
    return rows


def test_pack_in_2040_does_not_make_other_packs_silent(tmp_path):
    write(tmp_path, fleet_with_wrong_clocks())
    assert run_query(tmp_path, "silent").rows == []


def test_last_days_end_at_the_servers_time_and_not_in_2040(tmp_path):
    write(tmp_path, fleet_with_wrong_clocks())
    assert select(tmp_path, "SELECT DISTINCT pack FROM hours", days=90).rows == [("correct",)]
    assert select(tmp_path, "SELECT count(*) FROM hours", days=1).rows == [(6,)]  # of the second day


def test_packs_with_a_wrong_clock_are_named_with_its_error(tmp_path):
    write(tmp_path, fleet_with_wrong_clocks())
    rows = {row["pack"]: row for row in run_query(tmp_path, "clocks").records}
    assert rows.keys() == {"ahead", "behind"}
    assert rows["ahead"]["clock_error_s"] == pytest.approx(3600.0 * (YEAR_2040 - BEGIN))
    assert rows["ahead"]["edge_time"] == "2040-01-01T22:00:00Z"
    assert rows["behind"]["clock_error_s"] == pytest.approx(3600.0 * (YEAR_1970 - BEGIN))
    assert (rows["ahead"]["quarantined_hours"], rows["ahead"]["last_received"]) == (30, "2025-11-25T06:00:00Z")


def test_quarantined_rows_are_stored_by_the_day_of_their_arrival(tmp_path):
    write(tmp_path, fleet_with_wrong_clocks())
    days = sorted(day.name for day in (tmp_path / QUARANTINE_FOLDER).iterdir())
    assert days == ["date=2025-11-24", "date=2025-11-25"]


def test_folder_with_quarantined_rows_only_names_their_packs(tmp_path):
    write(tmp_path, [row for row in fleet_with_wrong_clocks() if row.pack == "ahead"])
    assert [row["pack"] for row in run_query(tmp_path, "clocks").records] == ["ahead"]
    assert run_query(tmp_path, "silent").rows == []


def test_rows_of_2040_from_an_older_worker_are_not_used(tmp_path):
    write(tmp_path, [make_hour("correct", BEGIN + n) for n in range(30)])
    write(tmp_path, [make_hour("ahead", YEAR_2040)])
    assert run_query(tmp_path, "silent").rows == []
    assert select(tmp_path, "SELECT DISTINCT pack FROM hours", days=90).rows == [("correct",)]
