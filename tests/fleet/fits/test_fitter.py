"""``fleet fit`` on a real server, with a worker that is killed."""

import asyncio
from collections.abc import Iterator
from contextlib import aclosing
from pathlib import Path

import pytest
from nats.aio.client import Client

from bms_estimator.edge import subjects
from bms_estimator.fleet.fits.messages import decode_result, from_bytes, is_fit
from bms_estimator.fleet.nats.stream_reader import StoredMessage, read_stream
from bms_estimator.fleet.nats.streams import make_streams
from bms_estimator.fleet.packs.pack_bucket import write_bucket
from bms_estimator.fleet.packs.pack_registry import PackRegistry
from bms_estimator.fleet.packs.pack_row import PackSpec, encode_row
from bms_estimator.fleet.worker.partition import Partition
from tests.fleet.nats_cluster import NatsCluster, connected, running
from tests.fleet.workers import Fitter, Heartbeats, Process, block, end_states, send
from tests.patience import LONG_S

PACK = "p1"
ROW = encode_row(PackSpec(cell="ncr18650", period_s=10.0, fit_interval_s=600.0, soc_std=0.02))
MAX_BLOCKS, LATER_BLOCKS = 12, 4


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[NatsCluster]:
    with running(tmp_path, partitions=1) as cluster:
        yield cluster


@pytest.fixture
def fitter(cluster: NatsCluster, tmp_path: Path) -> Iterator[Fitter]:
    process = Fitter(tmp_path, cluster.url)
    yield process
    assert process.end() == 0


async def stored(nc: Client, stream: str, subject: str) -> list[StoredMessage]:
    """Return the messages of a stream on a subject."""
    async with aclosing(read_stream(nc, stream, subject)) as batches:
        return [message async for batch in batches for message in batch]


async def until_answered(nc: Client) -> None:
    """Wait until no request for a fit is left."""
    async with asyncio.timeout(LONG_S):
        while (await nc.jetstream().stream_info(subjects.FITS_STREAM)).state.messages:  # noqa: ASYNC110
            await asyncio.sleep(0.05)


async def adoptable_fit(nc: Client) -> bool:
    """Return True if the last result of a fit will be adopted."""
    results = [decode_result(message.data) for message in await stored(nc, subjects.RAW_STREAM, "p.0.fit.*")]
    return bool(results) and results[-1].fit is not None and results[-1].min_filter_std == 0.0


@pytest.mark.thorough
async def test_worker_that_is_killed_between_a_fit_and_its_adoption_changes_no_bit(tmp_path, cluster, fitter) -> None:
    nc = await connected(cluster.urls)
    await make_streams(nc, partitions=1)
    await write_bucket(nc, subjects.PACKS_BUCKET, {PACK: ROW})
    registry = PackRegistry()
    registry.set_row(PACK, ROW)
    worker, number = Process(tmp_path, cluster.url, "w1", "--checkpoint-s", 10_000), 0
    try:
        async with Heartbeats(nc) as heartbeats:
            while number < MAX_BLOCKS and not await adoptable_fit(nc):
                number += 1
                await send(nc, PACK, block(PACK, number))
                await heartbeats.until(lambda last, n=number: "w1" in last and last["w1"].blocks == n)
                await heartbeats.until(lambda last: last["w1"].hours_waiting == 0)
                await until_answered(nc)
            worker.kill()
            worker = Process(tmp_path, cluster.url, "w2")
            for later in range(number + 1, number + LATER_BLOCKS + 1):
                await send(nc, PACK, block(PACK, later))
            await heartbeats.until(
                lambda last: "w2" in last and last["w2"].counters.get("blocks") == number + LATER_BLOCKS
            )
            assert await worker.end() == 0
    finally:
        worker.kill()
    undisturbed, ended = Partition(0, registry), (await end_states(nc, registry, 1))[0]
    for message in await stored(nc, subjects.RAW_STREAM, subjects.stored(0)):
        if message.sequence <= ended.sequence:  # ``fleet fit`` still runs
            undisturbed.process(PACK, message.data, message.sequence)
    state, expected = ended.state(PACK), undisturbed.state(PACK)
    assert expected["fit"]["in_force"]["sequence"][0] > 0
    assert state["fit"].tobytes() == expected["fit"].tobytes()
    assert state["estimator"].tobytes() == expected["estimator"].tobytes()
    await assert_history_has_each_row_once(nc, undisturbed)
    await nc.close()


async def assert_history_has_each_row_once(nc: Client, undisturbed: Partition) -> None:
    """Check that the takeover, which sent rows again, has not repeated any."""
    history = [
        from_bytes(message.data) for message in await stored(nc, subjects.HISTORY_STREAM, subjects.history(PACK))
    ]
    assert "answered" in history[0]
    elapsed_s = [second for arrays in history for second in arrays["rows"]["elapsed_s"].tolist()]
    assert elapsed_s == sorted(set(elapsed_s))
    assert is_fit((await stored(nc, subjects.RAW_STREAM, "p.0.fit.*"))[0].data)
    assert len(elapsed_s) + int(undisturbed.state(PACK)["estimator"]["history"]["count"][0]) >= 8
