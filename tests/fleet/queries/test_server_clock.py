"""A node of the server with a really wrong clock: answers stay right, the clock is named, and its rows are repaired."""

import shutil
import time
from contextlib import suppress
from pathlib import Path

import pytest
from nats.errors import Error as NatsError

from bms_estimator.edge.block import Block, encode
from bms_estimator.edge.subjects import HOURS_STREAM, RAW_STREAM
from bms_estimator.fleet.hour_row import HOUR_S, Hour
from bms_estimator.fleet.nats.stream_reader import read_stream
from bms_estimator.fleet.nats.streams import make_streams
from bms_estimator.fleet.queries.duckdb_queries import run_query, select
from bms_estimator.fleet.queries.parquet_files import write
from tests.command_line import run
from tests.fleet.nats_cluster import connected, running
from tests.fleet.worker.test_edge_clock import samples_until
from tests.fleet.workers import Heartbeats, Process, load_packs, send

PACKS = ["p1", "p2", "p3", "p4"]
DAY_S = 86_400


@pytest.fixture
def a_day_ahead():
    """Return the command that runs a program with a clock a day ahead.

    nats-server reads the clock without libc, so that libfaketime has an effect only on its emulator's system calls.
    """
    library = next(Path("/usr/lib").glob("*/faketime/libfaketime.so.1"), None)
    if library is None or shutil.which("qemu-x86_64") is None:
        pytest.skip("libfaketime or qemu-x86_64 is not installed (apt install libfaketime qemu-user)")
    return ["env", f"LD_PRELOAD={library}", f"FAKETIME=+{DAY_S}", "DONT_FAKE_MONOTONIC=1", "qemu-x86_64"]


@pytest.mark.thorough
async def test_leader_with_a_clock_a_day_ahead_is_named_and_its_rows_are_repaired(tmp_path, capsys, a_day_ahead):
    store_s = (int(time.time()) // HOUR_S - 4) * HOUR_S
    with running(tmp_path, 3, partitions=1) as cluster:
        nc = await connected(cluster.urls)
        await make_streams(nc, partitions=1, replicas=3)
        await load_packs(nc, PACKS)
        worker = Process(tmp_path, cluster.url, "w1")

        async def send_hours(first, last):
            for number in range(first, last + 1):
                data = encode(Block(store_s * 10**9, number, 1, time.time(), samples_until(HOUR_S * number - 60.0)))
                for pack in PACKS:
                    await send(nc, pack, data)

        try:
            async with Heartbeats(nc) as heartbeats:
                await send_hours(1, 2)
                wrong = (cluster.leader(RAW_STREAM) + 1) % 3
                cluster.kill(wrong)
                cluster.start(wrong, prefix=a_day_ahead)
                step_down = f"$JS.API.STREAM.LEADER.STEPDOWN.{RAW_STREAM}"
                while cluster.leader(RAW_STREAM) != wrong:
                    with suppress(NatsError):  # while the cluster elects a leader, no node answers
                        await nc.request(step_down, b'{"placement": {"preferred": "n%d"}}' % wrong, timeout=5.0)
                await send_hours(3, 4)
                cluster.kill(wrong)
                cluster.start(wrong)
                await send_hours(5, 5)
                await heartbeats.until(
                    lambda last: "w1" in last and last["w1"].counters.get("blocks") == 5 * len(PACKS)
                )
            assert await worker.end() == 0
        finally:
            worker.kill()
        folder, stored = tmp_path / "rows", read_stream(nc, HOURS_STREAM, ">")
        write(folder, [Hour.model_validate_json(each.data) async for batch in stored for each in batch])
        await nc.close()
    assert run_query(folder, "silent").rows == []
    (row,) = run_query(folder, "clocks").records
    assert (row["clock"], row["clock_error_s"]) == ("server", pytest.approx(DAY_S, abs=3 * HOUR_S))
    assert run(capsys, "fleet", "repair", "--folder", folder) == (0, f"{folder}: {2 * len(PACKS)} rows repaired\n", "")
    assert run_query(folder, "clocks").rows == run_query(folder, "silent").rows == []
    assert select(folder, "SELECT count(*) FROM hours").rows == [(4 * len(PACKS),)]
