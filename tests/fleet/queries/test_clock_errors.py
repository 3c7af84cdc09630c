"""Wrong clocks of edges, of the server and of the asking machine: no other pack's answers change, and the clock is named."""

import time

import pytest

from bms_estimator.fleet.queries.duckdb_queries import run_query, select
from bms_estimator.fleet.queries.parquet_files import QUARANTINE_FOLDER, write
from bms_estimator.fleet.queries.row_erasure import repair_arrivals
from tests.command_line import run
from tests.fleet.hour_rows import BEGIN, make_hour

YEAR_2040 = 613_600
"""An hour in the year 2040 [hours since 1970]."""
NOW_S = 3600.0 * (BEGIN + 30) + 600.0
"""Present time: the last rows of ``fleet_with_wrong_clocks`` have just arrived [s since 1970]."""
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
    assert run_query(tmp_path, "silent", wall=lambda: NOW_S).rows == []


def test_last_days_end_at_the_servers_time_and_not_in_2040(tmp_path):
    write(tmp_path, fleet_with_wrong_clocks())
    assert select(tmp_path, "SELECT DISTINCT pack FROM hours", days=90).rows == [("correct",)]
    assert select(tmp_path, "SELECT count(*) FROM hours", days=1).rows == [(6,)]  # of the second day


def test_packs_with_a_wrong_clock_are_named_with_its_error(tmp_path):
    write(tmp_path, fleet_with_wrong_clocks())
    rows = {row["pack"]: row for row in run_query(tmp_path, "clocks").records}
    assert rows.keys() == {"ahead", "behind"}
    assert rows["ahead"]["clock_error_s"] == pytest.approx(3600.0 * (YEAR_2040 - BEGIN))
    assert rows["ahead"]["clock_time"] == "2040-01-01T22:00:00Z"
    assert rows["behind"]["clock_error_s"] == pytest.approx(3600.0 * (YEAR_1970 - BEGIN))
    assert (rows["ahead"]["quarantined_hours"], rows["ahead"]["last_received"]) == (30, "2025-11-25T06:00:00Z")


def test_quarantined_rows_are_stored_by_the_day_of_their_arrival(tmp_path):
    write(tmp_path, fleet_with_wrong_clocks())
    days = sorted(day.name for day in (tmp_path / QUARANTINE_FOLDER).iterdir())
    assert days == ["date=2025-11-24", "date=2025-11-25"]


def test_folder_with_quarantined_rows_only_names_their_packs(tmp_path):
    write(tmp_path, [row for row in fleet_with_wrong_clocks() if row.pack == "ahead"])
    assert [row["pack"] for row in run_query(tmp_path, "clocks").records] == ["ahead"]
    assert run_query(tmp_path, "silent", wall=lambda: NOW_S).rows == []


def test_rows_of_2040_from_an_older_worker_are_not_used(tmp_path):
    write(tmp_path, [make_hour("correct", BEGIN + n) for n in range(30)])
    write(tmp_path, [make_hour("ahead", YEAR_2040)])
    assert run_query(tmp_path, "silent", wall=lambda: NOW_S).rows == []
    assert select(tmp_path, "SELECT DISTINCT pack FROM hours", days=90).rows == [("correct",)]


HOURS = 60
"""Number of hours of ``fleet_with_server_clock``."""


def fleet_with_server_clock(error_h, first=50, last=53):
    """Return rows of four packs, whose blocks arrived with a wrong server clock in some hours.

    Args:
        error_h: Error of the server's clock in these hours [h].
        first, last: These hours [hours since ``BEGIN``].
    """
    rows = []
    for n in range(HOURS):
        received = BEGIN + n + 1 + (error_h if first <= n < last else 0)
        apparent_h = BEGIN + n + 1 - received
        error_s = 3600.0 * apparent_h if apparent_h > 0 or apparent_h < -366 * 24 else None
        rows += [
            make_hour(f"p{k}", BEGIN + n, revision=4 * n + k + 1, received_hour=received, clock_error_s=error_s)
            for k in range(4)
        ]
    return rows


def wall():
    return 3600.0 * (BEGIN + HOURS) + 600.0


YEAR_H = 365 * 24


@pytest.mark.parametrize("error_h", [24, 5 * YEAR_H, -20 * YEAR_H], ids=["a day ahead", "in 2030", "in 2005"])
def test_wrong_clock_of_the_server_for_some_hours_is_named_and_repaired_and_changes_no_answer(tmp_path, error_h):
    write(tmp_path, fleet_with_server_clock(error_h))
    assert run_query(tmp_path, "silent", wall=wall).rows == []
    (row,) = run_query(tmp_path, "clocks", wall=wall).records
    assert (row["clock"], row["pack"]) == ("server", None)
    assert row["clock_error_s"] == pytest.approx(3600.0 * error_h)
    assert row["quarantined_hours"] == 12
    notes = run_query(tmp_path, "silent", wall=wall).notes
    assert [("12 rows of 4 packs arrived in the future" in note) for note in notes] == [True] * (error_h > 0)
    assert repair_arrivals(tmp_path, wall=wall) == 12
    assert run_query(tmp_path, "clocks", wall=wall).rows == []
    answer = run_query(tmp_path, "silent", wall=wall)
    assert (answer.rows, answer.notes) == ([], ())
    assert select(tmp_path, "SELECT count(*) FROM hours").rows == [(4 * HOURS,)]
    assert repair_arrivals(tmp_path, wall=wall) == 0


def test_clock_of_the_asking_machine_that_is_behind_is_named_and_the_servers_clock_is_used(tmp_path):
    write(tmp_path, fleet_with_server_clock(0))
    answer = run_query(tmp_path, "silent", wall=lambda: 0.0)
    assert answer.rows == []
    assert [note.startswith("the clock of this machine is ") for note in answer.notes] == [True]
    assert run_query(tmp_path, "clocks", wall=lambda: 0.0).rows == []
    assert repair_arrivals(tmp_path, wall=lambda: 0.0) == 0


def test_command_prints_the_warning_and_repairs_the_files(tmp_path, capsys):
    now = int(time.time()) // 3600
    rows = [make_hour("a", now - 1, revision=1, received_hour=now)]
    write(tmp_path, [*rows, make_hour("b", now - 1, revision=2, received_hour=now + 48)])
    code, out, err = run(capsys, "fleet", "ask", "silent", "--folder", tmp_path)
    assert (code, out.splitlines()[-1]) == (0, "none")
    assert err.startswith("note: 1 rows of 1 packs arrived in the future by the server's clock")
    assert run(capsys, "fleet", "repair", "--folder", tmp_path) == (0, f"{tmp_path}: 1 row repaired\n", "")
    assert run(capsys, "fleet", "ask", "silent", "--folder", tmp_path)[2] == ""
