"""Collector, which writes the hour rows of the real server to Parquet files: no row is lost, and files are merged."""

import asyncio
import contextlib
import shutil
from pathlib import Path

import duckdb
import nats
import pytest

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.streams import make_streams
from bms_estimator.fleet.queries.collector import Collector, only_collector
from bms_estimator.fleet.queries.parquet_files import (
    MAX_FILES_PER_DAY,
    UNFINISHED_SUFFIX,
    compact,
    complete_files,
    days_to_compact,
    write,
)
from bms_estimator.model.errors import UserError
from tests.command_line import PROGRAM
from tests.fleet.hour_rows import make_hour
from tests.fleet.nats_cluster import running
from tests.patience import LONG_S, until

MIDNIGHT = 490_000 // 24 * 24
"""Hour of a midnight [hours since 1970]."""


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    with running(tmp_path_factory.mktemp("cluster"), partitions=1) as cluster:
        yield cluster


@pytest.fixture
async def nc(cluster):
    """Yield a connection to a server with an empty stream of hours."""
    nc = await nats.connect(cluster.url)
    await make_streams(nc, partitions=1)
    await nc.jetstream().purge_stream(subjects.HOURS_STREAM)
    yield nc
    await nc.close()


async def publish(nc, rows):
    """Publish hour rows, as workers do."""
    for row in rows:
        await nc.publish(subjects.hours(row.pack), row.model_dump_json().encode())
    await nc.flush()


def rows_of(folder: Path):
    """Return the rows of all complete files."""
    with duckdb.connect() as database:
        files = [str(file) for day in folder.glob("date=*") for file in complete_files(day)]
        return database.read_parquet(files).fetchall() if files else []


@contextlib.asynccontextmanager
async def running_collector(collector):
    """Run a collector and shut it down at the end."""
    stop = asyncio.Event()
    task = asyncio.create_task(collector.run(stop))
    try:
        yield task
    finally:
        stop.set()
        await task


async def test_permanently_closed_connection_is_a_user_error(cluster, tmp_path):
    nc = await nats.connect(cluster.url)
    await make_streams(nc, partitions=1)
    await nc.close()
    with pytest.raises(UserError, match="closed the connection"):
        await Collector(nc, tmp_path).run(asyncio.Event())


async def test_rows_are_written_by_day_and_acknowledged(nc, tmp_path):
    await publish(nc, [make_hour("a", MIDNIGHT - 1), make_hour("a", MIDNIGHT), make_hour("b", MIDNIGHT)])
    collector = Collector(nc, tmp_path, period_s=0.0)
    async with running_collector(collector):
        await until(lambda: collector.counters["rows"] == 3)
    assert sorted(day.name for day in tmp_path.iterdir()) == ["date=2025-11-23", "date=2025-11-24"]
    js, unprocessed = nc.jetstream(timeout=LONG_S), None
    async with asyncio.timeout(LONG_S):  # the server processes acknowledgments asynchronously
        while unprocessed != (0, 0):
            info = await js.consumer_info(subjects.HOURS_STREAM, "collector")
            unprocessed = info.num_ack_pending, info.num_pending


async def test_rows_in_memory_are_written_at_shutdown_and_invalid_rows_are_counted(nc, tmp_path):
    collector = Collector(nc, tmp_path, period_s=3600.0)
    async with running_collector(collector):
        await nc.publish(subjects.hours("x"), b"{}")
        await publish(nc, [make_hour("a", MIDNIGHT)])
        await until(lambda: collector.counters["unreadable"] == 1 and collector._waiting)
        assert rows_of(tmp_path) == []
    assert len(rows_of(tmp_path)) == 1


@pytest.mark.thorough
async def test_unacknowledged_rows_of_a_killed_collector_are_redelivered(cluster, nc, tmp_path):
    """Kill the command while it has waiting and written rows, and continue with another collector."""
    rows = [make_hour(f"p{n}", MIDNIGHT + hour) for hour in range(4) for n in range(500)]
    command = PROGRAM, "fleet", "collect", "--server", cluster.url, "--folder", tmp_path, "--period", "0"
    process = await asyncio.create_subprocess_exec(*command)
    await publish(nc, rows[:1000])
    await until(lambda: rows_of(tmp_path) or process.returncode is not None)
    await publish(nc, rows[1000:])
    with pytest.raises(UserError, match="another collector writes there"), only_collector(tmp_path):
        pass
    process.kill()
    await process.wait()
    collector = Collector(nc, tmp_path, period_s=0.0)
    with only_collector(tmp_path):
        async with running_collector(collector):
            await until(lambda: collector._subscription)
            config = (await nc.jetstream().consumer_info(subjects.HOURS_STREAM, "collector")).config
            config.ack_wait = 0.5  # the collector's 60 s would delay the redelivery
            await nc.jetstream().add_consumer(subjects.HOURS_STREAM, config)
            await until(lambda: len({row[:2] for row in rows_of(tmp_path)}) == len(rows))


async def test_missing_stream_is_a_user_error(nc, tmp_path):
    await nc.jetstream().delete_stream(subjects.HOURS_STREAM)
    with pytest.raises(UserError, match="no stream HOURS: `bms-estimator fleet serve` creates it"):
        await Collector(nc, tmp_path).run(asyncio.Event())


def test_files_of_a_day_are_merged_after_the_end_of_the_day_or_if_they_are_many(tmp_path):
    for n in range(3):
        write(tmp_path, [make_hour("b", MIDNIGHT), make_hour("a", MIDNIGHT + n)])
    after_day_s = (MIDNIGHT + 27) * 3600.0  # 3 h after the end of the day
    assert days_to_compact(tmp_path, after_day_s - 2 * 3600.0) == []  # 1 h after the end, late rows may still come
    (day,) = days_to_compact(tmp_path, after_day_s)
    (day / f".x.parquet{UNFINISHED_SUFFIX}").touch()
    (day / "half.parquet").write_bytes(b"PAR1 and no more")  # only the magic bytes are valid
    compact(day)
    assert [row[:2] for row in rows_of(tmp_path)] == [("a", MIDNIGHT + n) for n in range(3)] + [("b", MIDNIGHT)]
    assert len(complete_files(day)) == 1
    assert days_to_compact(tmp_path, after_day_s) == []
    # with the merged file, this file and its copies, the day has MAX_FILES_PER_DAY files
    (file,) = write(tmp_path, [make_hour("c", MIDNIGHT)])
    for n in range(MAX_FILES_PER_DAY - 2):
        shutil.copy(file, day / f"batch-{n}.parquet")
    assert days_to_compact(tmp_path, after_day_s) == [day]


async def test_row_that_cannot_be_written_is_not_acknowledged(nc, tmp_path, monkeypatch):
    folder = tmp_path / "hours"
    folder.touch()  # a file where the folder should be
    await publish(nc, [make_hour("a", MIDNIGHT)])
    collector = Collector(nc, folder, period_s=0.0)
    async with running_collector(collector):
        await until(lambda: collector.counters["faults"])
    info = await nc.jetstream().consumer_info(subjects.HOURS_STREAM, "collector")
    assert info.num_ack_pending == 1
