"""Packs of which nothing arrives: judged by the server's clock at the arrival of rows, and by the table of packs."""

import pytest

from bms_estimator.edge import subjects
from bms_estimator.fleet.packs.pack_bucket import remove_keys, write_bucket
from bms_estimator.fleet.queries.collector import Collector
from bms_estimator.fleet.queries.duckdb_queries import run_query
from bms_estimator.fleet.queries.parquet_files import read_packs, write, write_packs
from tests.fleet.hour_rows import BEGIN, make_hour
from tests.fleet.queries.test_collector import running_collector
from tests.patience import until

NOW = BEGIN + 100
"""Present hour [hours since 1970]."""


def rows(pack, last_arrival, behind_h=0, **values):
    """Return a day's rows of a pack whose clock is ``behind_h`` behind [h]."""
    hours = range(last_arrival - 23, last_arrival + 1)
    return [make_hour(pack, n - 1 - behind_h, revision=n, received_hour=n, **values) for n in hours]


def silent(folder, now_hour=NOW):
    answer = run_query(folder, "silent", wall=lambda: 3600.0 * now_hour + 600.0)
    return {row["pack"]: row["hours_silent"] for row in answer.records}


def test_pack_with_a_late_clock_is_live_and_its_clock_is_named(tmp_path):
    write(tmp_path, [*rows("live", NOW), *rows("late", NOW, behind_h=30 * 24), *rows("gone", NOW - 3)])
    assert silent(tmp_path) == {"gone": 3}
    (row,) = run_query(tmp_path, "clocks", wall=lambda: 3600.0 * NOW).records
    assert (row["clock"], row["pack"], row["clock_error_s"]) == ("edge", "late", -30 * 86_400.0)
    assert row["quarantined_hours"] == 0


def test_pack_that_sends_stored_blocks_has_no_wrong_clock(tmp_path):
    stored = [make_hour("a", NOW - 90 + n, revision=n, received_hour=NOW - 4 + n // 20) for n in range(80)]
    write(tmp_path, stored)
    assert run_query(tmp_path, "clocks", wall=lambda: 3600.0 * NOW).rows == []


def test_quarantined_pack_becomes_silent(tmp_path):
    write(tmp_path, [*rows("live", NOW), *rows("gone", NOW - 9, behind_h=9000, clock_error_s=-3.2e7)])
    assert silent(tmp_path) == {"gone": 9}


def test_all_packs_are_silent_if_the_collector_has_stopped(tmp_path):
    write(tmp_path, [*rows("a", NOW), *rows("b", NOW)])
    assert silent(tmp_path, NOW + 5) == {"a": 5, "b": 5}
    (note,) = run_query(tmp_path, "silent", wall=lambda: 3600.0 * (NOW + 5)).notes
    assert note.endswith("do workers and `fleet collect` run?")


def test_pack_of_the_table_that_never_sent_is_named_and_a_removed_one_is_not(tmp_path):
    write(tmp_path, [*rows("live", NOW), *rows("removed", NOW - 9)])
    write_packs(tmp_path, {"live": NOW - 50, "never": NOW - 50, "new": NOW - 1})
    assert silent(tmp_path) == {"never": None}


async def test_collector_stores_the_packs_of_the_table(nc, tmp_path, monkeypatch):
    monkeypatch.setattr("bms_estimator.fleet.queries.collector.TABLE_S", 0.0)
    await write_bucket(nc, subjects.PACKS_BUCKET, {"a": b"{}", "b": b"{}"})
    write_packs(tmp_path, {"a": 7})
    async with running_collector(Collector(nc, tmp_path)):
        await until(lambda: "b" in read_packs(tmp_path))
        assert read_packs(tmp_path)["a"] == 7  # since when a pack is in the table survives a restart
        await remove_keys(nc, subjects.PACKS_BUCKET, ["b"])
        await until(lambda: read_packs(tmp_path) == {"a": 7})


@pytest.mark.parametrize("behind_h", [0, 400 * 24], ids=["valid", "quarantined"])
def test_row_without_an_arrival_counts_by_its_hour(tmp_path, behind_h):
    error_s = -3600.0 * behind_h if behind_h else None
    write(tmp_path, [make_hour("a", NOW - 5 - behind_h, clock_error_s=error_s), *rows("live", NOW)])
    assert silent(tmp_path) == {"a": 4 + behind_h}
