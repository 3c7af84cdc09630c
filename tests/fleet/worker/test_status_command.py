"""``fleet status`` with heartbeats of workers of several versions."""

import asyncio
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager

import nats
import pytest

from bms_estimator.cli.fleet import status as status_command
from bms_estimator.edge import subjects
from bms_estimator.fleet.heartbeat import Heartbeat
from bms_estimator.fleet.nats.streams import make_streams
from bms_estimator.process.runtime import end_tasks
from tests.command_line import run
from tests.fleet.nats_cluster import NatsCluster, running
from tests.patience import LONG_S

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
        await end_tasks(task)


async def status(capsys: pytest.CaptureFixture[str], url: str, *options: object) -> tuple[int, str, str]:
    return await asyncio.to_thread(run, capsys, "fleet", "status", "--server", url, *options)


async def test_formats_of_workers_are_listed_and_an_older_block_version_gives_exit_code_1(cluster, capsys) -> None:
    new = Heartbeat(id="new", started_s=1.79e9, version="9.9", checkpoint_format=2, block_version=2).model_dump_json()
    old = Heartbeat(id="old", started_s=1.79e9, version="9.8", partitions=(0, 1), packs=7).model_dump_json()
    async with sending(cluster.url, old.encode(), new.encode()):
        code, out, err = await status(capsys, cluster.url, "--blocks", 2)
    assert (code, err) == (1, "")
    assert [line.split() for line in out.splitlines() if line.strip().startswith(("new", "old"))] == [
        ["new", "9.9", "0", "0", "1,", "2", "2"],
        ["old", "9.8", "2", "7", "1", "1"],
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


async def test_trouble_of_a_worker_and_unknown_packs_that_send_are_listed(cluster, capsys) -> None:
    heartbeat = Heartbeat(id="w", started_s=1.79e9, trouble="no space", unknown=("x", "y"), unknown_count=5)
    async with sending(cluster.url, heartbeat.model_dump_json().encode()):
        code, out, _ = await status(capsys, cluster.url)
    assert code == 0
    lines = out.splitlines()
    assert "w: no space" in lines
    assert [line.partition(":")[0] for line in lines if "unknown pack that sends blocks" in line] == ["x", "y"]
    assert "w: 3 more unknown packs" in lines


async def test_wrong_clock_of_the_server_is_named_instead_of_all_edges(cluster, capsys) -> None:
    errors = {f"p{n}": -1e8 for n in range(4)}
    heartbeat = Heartbeat(id="w", started_s=1.79e9, packs=5, clock_error_count=4, clock_errors=errors)
    async with sending(cluster.url, heartbeat.model_dump_json().encode()):
        _, out, _ = await status(capsys, cluster.url)
    assert "w: the clocks of 4 edges of 5 differ from the server's: check the clocks of its nodes" in out.splitlines()


async def test_one_node_of_three_is_the_reason_why_streams_cannot_be_read(tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.setattr(status_command, "STREAMS_TIMEOUT_S", 2.0)
    heartbeat = Heartbeat(id="w", started_s=1.79e9)
    with running(tmp_path, 3, partitions=2) as cluster:
        async with await nats.connect(cluster.url) as nc:
            await make_streams(nc, partitions=2, replicas=3)
        cluster.kill(0)
        cluster.kill(1)
        url = cluster.urls[2]
        async with sending(url, heartbeat.model_dump_json().encode()), asyncio.timeout(LONG_S):
            out = ""
            while "the streams cannot be read" not in out:  # a leader without followers responds for some seconds
                code, out, _ = await status(capsys, url)
    assert code == 0
    assert any(line.split()[:1] == ["w"] for line in out.splitlines())
    assert "are most nodes up?" in out
    assert "was it started by `fleet serve`" not in out


async def test_unreadable_heartbeat_is_reported_and_the_others_are_listed(cluster, capsys) -> None:
    old = Heartbeat(id="old", started_s=1.79e9).model_dump_json()
    async with sending(cluster.url, b"{}", old.encode()):
        code, out, err = await status(capsys, cluster.url)
    assert (code, "old" in out) == (0, True)
    assert err.startswith("warning: the heartbeat on fleet.worker.w0 is unreadable")
