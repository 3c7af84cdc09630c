"""Rows of one minute in the history: their content, restarts within a minute, reading while the service writes."""

import asyncio
import sqlite3
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from bms_estimator.model.clock import iso_utc
from bms_estimator.model.errors import UserError
from bms_estimator.model.payloads.snapshot import Snapshot
from bms_estimator.store import database as database_module, history as history_module
from bms_estimator.store.database import Database, StoreError
from bms_estimator.store.history import HistorySink, Minute
from bms_estimator.store.history_reader import HistoryReader, PastEvent
from tests.doctor.as_user import as_nobody
from tests.patience import LONG_S, until
from tests.sinks.snapshots import CELL_SNAPSHOT

BEGIN_S = 1_700_000_040
"""Start of a minute [s since 1970]."""


def snapshot_at(second: float, current_a: float = 2.0, voltage_v: float = 4.0, **changes: object) -> Snapshot:
    """Return a snapshot that is published ``second`` seconds after ``BEGIN_S``."""
    assert CELL_SNAPSHOT.estimate
    measured = {
        "time": iso_utc(BEGIN_S + second),
        "board_time_s": second,
        "current_a": current_a,
        "voltage_v": voltage_v,
        "power_w": current_a * voltage_v,
    }
    return CELL_SNAPSHOT._replace(estimate=CELL_SNAPSHOT.estimate.model_copy(update=measured | changes))


async def record_history(path: Path, snapshots: list[Snapshot], days: int = 366) -> None:
    """Write the snapshots to a history as one run of a service does. ``days`` is the length of the history."""
    async with Database(path) as database, HistorySink(database, days=days) as history:
        for each in snapshots:
            history.publish(each)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "pack.sqlite"


def read_rows(path: Path, step_s: int = 60) -> list[Minute]:
    """Return all rows, aggregated to steps of ``step_s``."""
    return HistoryReader(path).rows(0.0, 2e10, step_s)


def past_events(path: Path) -> list[PastEvent]:
    return HistoryReader(path).events(0.0, 2e10)


async def test_row_has_means_extremes_and_sums_of_the_publications(path):
    currents_a = [3.6] * 30 + [-7.2] * 30  # at 4 V, once a second
    await record_history(
        path, [snapshot_at(float(s), a, soc=0.5 + s / 1000, temperature_c=None) for s, a in enumerate(currents_a)]
    )
    [row] = read_rows(path)
    assert (row.time_s, row.publications, row.seen_s) == (BEGIN_S, 60, 59.0)
    assert (row.current_a, row.current_min_a, row.current_max_a) == (pytest.approx(-1.8), -7.2, 3.6)
    # the charge of the second before the first publication is unknown
    assert (row.charge_out_ah, row.charge_in_ah) == (pytest.approx(0.029), pytest.approx(0.06))
    assert (row.energy_out_wh, row.energy_in_wh) == (pytest.approx(0.116), pytest.approx(0.24))
    assert (row.soc, row.temperature_c) == (pytest.approx(0.559), None)


async def test_no_charge_is_counted_over_a_gap(path):
    await record_history(path, [snapshot_at(0.0), snapshot_at(1.0), snapshot_at(3000.0), snapshot_at(3001.0)])
    assert sum(row.seen_s for row in read_rows(path)) == 2.0


async def test_intervals_of_one_minute_are_no_gaps_if_that_is_the_period_of_the_source(path):
    await record_history(path, [snapshot_at(60.0 * i, 6.0) for i in range(11)])
    # ten intervals of 0.1 Ah; the first counts as a gap, because no interval before it shows the period
    assert sum(row.charge_out_ah for row in read_rows(path)) == pytest.approx(0.9)


async def test_two_runs_within_a_minute_give_one_row(path):
    snapshots = [
        snapshot_at(float(s), s / 10, 3.0 + s / 100, soc_std=s / 1e3, temperature_c=20.0 + s if s % 2 else None)
        for s in range(60)
    ]
    await record_history(path.with_name("whole.sqlite"), snapshots)
    await record_history(path, snapshots[:25])
    await record_history(path, snapshots[25:])
    [row], [expected] = read_rows(path), read_rows(path.with_name("whole.sqlite"))
    lost_ah = 2.5 / 3600  # charge of the second between the two runs, in which the voltage is 3.25 V
    # the mean of each run is weighted with all its publications, although half of them have no temperature
    assert row.temperature_c == pytest.approx(expected.temperature_c, abs=0.5)
    assert row._replace(temperature_c=None) == pytest.approx(
        expected._replace(
            temperature_c=None,
            seen_s=expected.seen_s - 1.0,
            charge_out_ah=expected.charge_out_ah - lost_ah,
            energy_out_wh=expected.energy_out_wh - lost_ah * 3.25,
        )
    )


async def test_minutes_repeated_by_a_clock_set_back_are_not_merged(path):
    before = [snapshot_at(float(s), 10.0) for s in range(300)]
    after = [snapshot_at(float(s), -10.0, board_time_s=300.0 + s) for s in range(300)]
    await record_history(path, before + after)
    stored = read_rows(path)
    assert len(stored) == 10
    assert max(row.seen_s for row in stored) <= 60.0
    assert [row.current_a for row in stored] == [10.0, -10.0] * 5
    [day] = read_rows(path, 86400)  # 10 A for 299 s and -10 A for 300 s
    assert (day.charge_out_ah, day.charge_in_ah) == (pytest.approx(299 / 360), pytest.approx(300 / 360))


async def test_rows_of_longer_steps_aggregate_minutes(path):
    """The two hours of samples begin between full hours, so that they touch three hours of the clock."""
    await record_history(path, [snapshot_at(float(s), s / 60, 3.0, soc=1.0 - s / 7200) for s in range(0, 7200, 10)])
    minutes, [first, second, last] = read_rows(path), read_rows(path, 3600)
    assert len(minutes) == 120
    assert sum(row.charge_out_ah for row in (first, second, last)) == pytest.approx(
        sum(row.charge_out_ah for row in minutes)
    )
    assert (last.soc, last.current_max_a) == (minutes[-1].soc, minutes[-1].current_max_a)
    assert first.current_min_a == 0.0
    assert first.time_s % 3600 == 0


async def test_a_full_history_keeps_the_rows_with_the_newest_times_also_after_a_jump_of_the_clock(path):
    await record_history(path, [snapshot_at(60.0 * minute) for minute in range(1500)])
    await record_history(path, [snapshot_at(1e9)], days=1)
    stored = read_rows(path)
    assert len(stored) == 1440  # minutes of a day: the future row, and the last 1439 of the rows 0 to 1499
    assert [row.time_s for row in stored[:2]] == [BEGIN_S + 60 * 61, BEGIN_S + 60 * 62]


async def test_events_are_stored_in_order(path):
    lost = snapshot_at(1.0)._replace(
        health=CELL_SNAPSHOT.health.model_copy(update={"sensor_online": False, "sensor_message": "no board"})
    )
    await record_history(path, [snapshot_at(0.0), lost])
    names = [event.name for event in past_events(path)]
    assert names == ["start", "sensor_online", "sensor_offline"]


async def test_event_is_written_before_its_minute_ends(path, monkeypatch):
    monkeypatch.setattr(history_module, "MINUTE_S", 3600)  # no minute ends
    async with Database(path) as database, HistorySink(database, days=366) as history:
        history.publish(snapshot_at(0.0))
        async with asyncio.timeout(LONG_S):
            while not await asyncio.to_thread(read_or_nothing, lambda: past_events(path)):  # noqa: ASYNC110 - a file
                await asyncio.sleep(0.01)
        assert read_rows(path) == []


async def test_history_is_read_while_the_service_writes_it(path):
    async with Database(path) as database, HistorySink(database, days=366) as history:
        history.publish(snapshot_at(0.0))
        history.publish(snapshot_at(60.0))  # ends the minute
        async with asyncio.timeout(LONG_S):
            while not path.exists() or not await asyncio.to_thread(read_or_nothing, lambda: read_rows(path)):  # noqa: ASYNC110
                await asyncio.sleep(0.01)


def read_or_nothing(read: Callable[[], list[Any]]) -> list[Any]:
    """Return what ``read`` returns; an empty list while there is no history."""
    try:
        return read()
    except UserError:
        return []  # the table does not exist yet


async def test_rows_wait_in_memory_while_the_disk_fails(path):
    path.mkdir()
    (path / "file").touch()
    async with Database(path, retry_s=0.0) as database, HistorySink(database, days=366) as history:
        # it renames any file that is not regular, and would therefore also rename the folder at the path
        database._file._quarantine_non_regular = leave_in_place  # type: ignore[method-assign]
        history.publish(snapshot_at(0.0))
        history.publish(snapshot_at(60.0))
        await until(lambda: database.failure_reason)
        (path / "file").unlink()
        path.rmdir()
    assert [row.time_s for row in read_rows(path)] == [BEGIN_S, BEGIN_S + 60]


def leave_in_place(_: Path) -> None:
    """Leave the folder at the database's path, so that the database cannot be opened."""


def test_unreadable_history_raises_an_error(path):
    with pytest.raises(UserError, match="no history there"):
        read_rows(path)
    with sqlite3.connect(path) as connection:
        connection.execute("PRAGMA user_version = 99")
    connection.close()
    with pytest.raises(UserError, match="later version"):
        read_rows(path)
    path.write_bytes(b"x" * 5000)
    with pytest.raises(UserError, match="cannot be read: file is not a database"):
        read_rows(path)


class DatabaseWithLostResults(Database):
    """Database that commits its first transactions but reports a failure."""

    remaining = 0

    async def call(self, work: Callable[[sqlite3.Connection], Any]) -> Any:
        result = await super().call(work)
        if self.remaining:
            self.remaining -= 1
            raise StoreError("unknown result")
        return result


async def test_rows_of_a_transaction_with_unknown_result_are_not_repeated(path, monkeypatch):
    monkeypatch.setattr(history_module, "WRITE_S", 0.0)  # no pause between two writes
    monkeypatch.setattr(history_module, "WRITTEN_ROWS", 2)  # a write is due when two minutes wait
    async with DatabaseWithLostResults(path, retry_s=0.0) as database, HistorySink(database, days=366) as history:
        database.remaining = 2
        for second in range(0, 190, 10):
            history.publish(snapshot_at(float(second)))
            # each ended minute is one transaction, and two of them report a failure
            remaining = max(2 - second // 60, 0)
            await until(lambda remaining=remaining: database.remaining <= remaining)
    assert [(row.publications, row.seen_s) for row in read_rows(path)] == [(6, 50.0), (6, 60.0), (6, 60.0), (1, 10.0)]
    assert len(past_events(path)) == 2


async def test_shutdown_during_a_write_writes_each_row_once(path):
    may_return = threading.Event()
    async with Database(path) as database, HistorySink(database, days=366) as history:
        history.publish(snapshot_at(0.0))
        busy = asyncio.create_task(database.call(lambda _: may_return.wait(LONG_S)))
        await asyncio.sleep(0)
        history.publish(snapshot_at(60.0))
        await asyncio.sleep(0)
        await asyncio.sleep(0)  # the write waits for the blocked transaction
        asyncio.get_running_loop().call_soon(may_return.set)
    await busy
    assert [row.publications for row in read_rows(path)] == [1, 1]


async def test_failed_vacuum_does_not_undo_a_transaction(path, monkeypatch):
    def fail(_: sqlite3.Connection) -> None:
        raise sqlite3.OperationalError("disk I/O error")

    monkeypatch.setattr(database_module, "_trim", fail)
    async with Database(path, retry_s=0.0) as database:
        # ``and None``: a cursor must not leave the thread of the database
        await database.call(lambda connection: connection.execute("DELETE FROM minute") and None)
        assert not database.failure_reason


class BrokenDatabase(Database):
    """Database with an internal error."""

    async def call(self, _: Callable[[sqlite3.Connection], Any]) -> Any:
        raise KeyError("internal")


async def publish_forever(history: HistorySink) -> None:
    async with asyncio.timeout(LONG_S):
        while True:
            history.publish(snapshot_at(0.0))
            history.publish(snapshot_at(60.0))
            await asyncio.sleep(0)


async def test_internal_error_of_the_writing_task_is_raised(path):
    history = await HistorySink(BrokenDatabase(path), days=366).__aenter__()
    with pytest.raises(KeyError, match="internal"):
        await publish_forever(history)


def error_of_reading(path: Path) -> str:
    """Return the error of reading a history."""
    with pytest.raises(UserError) as caught:
        read_rows(path)
    return str(caught.value)


async def test_history_in_a_folder_without_permission_is_a_user_error(path):
    await record_history(path, [snapshot_at(0.0)])
    path.parent.chmod(0o000)
    error = as_nobody(lambda: error_of_reading(path))
    path.parent.chmod(0o700)
    assert error.startswith(f"{path}: no permission to read the history: run the command as the user of the service")


async def test_damaged_history_is_a_user_error(path):
    await record_history(path, [snapshot_at(60.0 * minute) for minute in range(500)])
    whole = path.read_bytes()
    for content, reason in (
        (whole[: len(whole) // 2], "history cannot be read: database disk image is malformed"),
        (b"\xff" * 600, "history cannot be read: file is not a database"),
        (b"", "not a history: the file has no tables"),
    ):
        path.write_bytes(content)
        assert error_of_reading(path).startswith(
            f"{path}: {reason}; the service moves a damaged file aside at its next start"
        )
