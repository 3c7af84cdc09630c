"""Hours from the real server into Parquet files: none lost, few files, each readable."""

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
from bms_estimator.fleet.queries.parquet_files import MANY, UNFINISHED, compact, sound_files, to_compact, write
from bms_estimator.model.errors import UserError
from tests.command_line import PROGRAM
from tests.fleet.engine import running
from tests.fleet.fleets import an_hour
from tests.patience import LONG_S

MIDNIGHT = 490_000 // 24 * 24


@pytest.fixture(scope="module")
def engine(tmp_path_factory):
    with running(tmp_path_factory.mktemp("engine"), partitions=1) as engine:
        yield engine


@pytest.fixture
async def nc(engine):
    """Connected, with an empty stream of hours."""
    nc = await nats.connect(engine.url)
    await make_streams(nc, partitions=1)
    await nc.jetstream().purge_stream(subjects.HOURS_STREAM)
    yield nc
    await nc.close()


async def publish(nc, rows):
    for row in rows:
        await nc.publish(subjects.hours(row.pack), row.model_dump_json().encode())
    await nc.flush()


def rows_of(folder: Path):
    with duckdb.connect() as base:
        files = [str(file) for day in folder.glob("date=*") for file in sound_files(day)]
        return base.read_parquet(files).fetchall() if files else []


async def until(condition):
    async with asyncio.timeout(LONG_S):
        while not condition():  # noqa: ASYNC110 - of files and of another process
            await asyncio.sleep(0.02)


@contextlib.asynccontextmanager
async def collecting(collector):
    stop = asyncio.Event()
    task = asyncio.create_task(collector.run(stop))
    try:
        yield task
    finally:
        stop.set()
        await task


async def test_a_connection_that_is_closed_for_good_ends_it(engine, tmp_path):
    nc = await nats.connect(engine.url)
    await make_streams(nc, partitions=1)
    await nc.close()
    with pytest.raises(UserError, match="closed the connection"):
        await Collector(nc, tmp_path).run(asyncio.Event())


async def test_rows_come_into_the_folder_of_their_day_and_are_acknowledged(nc, tmp_path):
    await publish(nc, [an_hour("a", MIDNIGHT - 1), an_hour("a", MIDNIGHT), an_hour("b", MIDNIGHT)])
    collector = Collector(nc, tmp_path, period_s=0.0)
    async with collecting(collector):
        await until(lambda: collector.counters["rows"] == 3)
    assert sorted(day.name for day in tmp_path.iterdir()) == ["date=2025-11-23", "date=2025-11-24"]
    js, left = nc.jetstream(timeout=LONG_S), None
    async with asyncio.timeout(LONG_S):  # the server takes acknowledgements when it comes to it
        while left != (0, 0):
            info = await js.consumer_info(subjects.HOURS_STREAM, "collector")
            left = info.num_ack_pending, info.num_pending


async def test_what_waits_is_written_at_the_end_and_rubbish_is_said(nc, tmp_path):
    collector = Collector(nc, tmp_path, period_s=3600.0)
    async with collecting(collector):
        await nc.publish(subjects.hours("x"), b"{}")
        await publish(nc, [an_hour("a", MIDNIGHT)])
        await until(lambda: collector.counters["unreadable"] == 1 and collector._waiting)
        assert rows_of(tmp_path) == []
    assert len(rows_of(tmp_path)) == 1


async def test_what_a_killed_one_had_not_acknowledged_comes_again(engine, nc, tmp_path):
    """The real command, killed while rows wait and others are on the disk; another goes on."""
    rows = [an_hour(f"p{n}", MIDNIGHT + hour) for hour in range(4) for n in range(500)]
    command = PROGRAM, "fleet", "collect", "--server", engine.url, "--folder", tmp_path, "--period", "0"
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
        async with collecting(collector):
            await until(lambda: collector._subscription)
            config = (await nc.jetstream().consumer_info(subjects.HOURS_STREAM, "collector")).config
            config.ack_wait = 0.5  # not after a minute, as the collector has it
            await nc.jetstream().add_consumer(subjects.HOURS_STREAM, config)
            await until(lambda: len({row[:2] for row in rows_of(tmp_path)}) == len(rows))


async def test_without_the_stream_it_is_said_who_makes_it(nc, tmp_path):
    await nc.jetstream().delete_stream(subjects.HOURS_STREAM)
    with pytest.raises(UserError, match="no stream HOURS: `bms-estimator fleet serve` makes it"):
        await Collector(nc, tmp_path).run(asyncio.Event())


def test_a_day_becomes_one_file_when_it_is_over_or_has_many(tmp_path):
    for n in range(3):
        write(tmp_path, [an_hour("b", MIDNIGHT), an_hour("a", MIDNIGHT + n)])
    late_s = (MIDNIGHT + 27) * 3600.0
    assert to_compact(tmp_path, late_s - 7200.0) == []
    (day,) = to_compact(tmp_path, late_s)
    (day / f".x.parquet{UNFINISHED}").touch()
    (day / "half.parquet").write_bytes(b"PAR1 and no more")
    compact(day)
    assert [row[:2] for row in rows_of(tmp_path)] == [("a", MIDNIGHT + n) for n in range(3)] + [("b", MIDNIGHT)]
    assert len(sound_files(day)) == 1
    assert to_compact(tmp_path, late_s) == []
    (late,) = write(tmp_path, [an_hour("c", MIDNIGHT)])
    for n in range(MANY - 2):
        shutil.copy(late, day / f"batch-{n}.parquet")
    assert to_compact(tmp_path, late_s) == [day]


async def test_a_disk_that_takes_nothing_loses_nothing(nc, tmp_path, monkeypatch):
    folder = tmp_path / "hours"
    folder.touch()  # a file where the folder should be
    await publish(nc, [an_hour("a", MIDNIGHT)])
    collector = Collector(nc, folder, period_s=0.0)
    async with collecting(collector):
        await until(lambda: collector.counters["faults"])
    info = await nc.jetstream().consumer_info(subjects.HOURS_STREAM, "collector")
    assert info.num_ack_pending == 1
