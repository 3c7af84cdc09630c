"""``fleet status`` with heartbeats of workers of several versions."""

import asyncio
import json
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager

import nats
import pytest

from bms_estimator.edge import subjects
from bms_estimator.fleet.heartbeat import Heartbeat
from bms_estimator.process.tasks import end
from tests.command_line import run
from tests.fleet.nats_cluster import NatsCluster, running
from tests.fleet.workers import OLD_HEARTBEAT

HOUR_S = 3600.0


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[NatsCluster]:
    with running(tmp_path_factory.mktemp("cluster"), partitions=2) as cluster:
        yield cluster


@asynccontextmanager
async def sending(url: str, *heartbeats: bytes) -> AsyncIterator[None]:
    """Publish heartbeats ten times a second."""

    async def send(nc: nats.NATS) -> None:
        while True:
            for number, data in enumerate(heartbeats):
                await nc.publish(subjects.worker(f"w{number}"), data)
            await asyncio.sleep(0.1)

    async with await nats.connect(url) as nc:
        task = asyncio.create_task(send(nc))
        yield
        await end(task)


async def status(capsys: pytest.CaptureFixture[str], url: str, *options: object) -> tuple[int, str, str]:
    return await asyncio.to_thread(run, capsys, "fleet", "status", "--server", url, *options)


async def test_worker_of_a_version_without_formats_is_listed_as_one_of_the_first_formats(cluster, capsys) -> None:
    new = Heartbeat(id="new", started_s=1.79e9, version="9.9", checkpoint_format=2, block_version=2).model_dump_json()
    async with sending(cluster.url, json.dumps(OLD_HEARTBEAT).encode(), new.encode()):
        code, out, err = await status(capsys, cluster.url, "--blocks", 2)
    assert (code, err) == (1, "")
    assert [line.split() for line in out.splitlines() if line.strip().startswith(("new", "old"))] == [
        ["new", "9.9", "0", "0", "1,", "2", "2"],
        ["old", "2", "7", "1", "1"],
    ]
    assert "blocks of version 2 are unreadable for old" in out


async def test_clock_errors_are_listed_with_their_packs(cluster, capsys) -> None:
    heartbeat = Heartbeat(
        id="w",
        started_s=1.79e9,
        clock_error_count=3,
        clock_errors={"p2": 2.0 * HOUR_S, "p3": -9000.0 * HOUR_S},
    )
    async with sending(cluster.url, heartbeat.model_dump_json().encode()):
        code, out, _ = await status(capsys, cluster.url)
    assert code == 0
    lines = [line for line in out.splitlines() if line.startswith("p") or "more pack" in line]
    assert [line.partition(":")[0] for line in lines] == ["p3", "p2", "w"]
    assert "is 375 days, 0:00:00 behind" in lines[0]
    assert "is 2:00:00 ahead" in lines[1]
    assert lines[2] == "w: 1 more pack with a wrong clock"


async def test_unreadable_heartbeat_is_reported_and_the_others_are_listed(cluster, capsys) -> None:
    async with sending(cluster.url, b"{}", json.dumps(OLD_HEARTBEAT).encode()):
        code, out, err = await status(capsys, cluster.url)
    assert (code, "old" in out) == (0, True)
    assert err.startswith("warning: the heartbeat on fleet.worker.w0 is unreadable")
