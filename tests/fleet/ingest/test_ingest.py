"""Batches that ``fleet ingest`` receives: the workers' states equal those of packs with edges."""

import asyncio
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path

import numpy as np
import pytest
from nats.aio.client import Client

from bms_estimator.edge import subjects
from bms_estimator.estimator.estimator import make_estimator
from bms_estimator.fleet.nats.streams import make_streams
from bms_estimator.fleet.packs.pack_registry import PackRegistry
from bms_estimator.fleet.worker.worker import Options, work
from bms_estimator.model.sample import SampleBlock
from tests.fleet.ingest.platform import START_S, json_batch, running_ingest, samples_of
from tests.fleet.nats_cluster import NatsCluster, connected, running
from tests.fleet.workers import Heartbeats, end_states, load_packs
from tests.patience import LONG_S

PARTITIONS = 2
COUNT = 300
"""Number of samples of a pack."""


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[NatsCluster]:
    with running(tmp_path, partitions=PARTITIONS) as cluster:
        yield cluster


@asynccontextmanager
async def worker(url: str, samples: int) -> AsyncIterator[None]:
    """Run a worker in this process until it has processed ``samples`` samples, and stop it, so that it saves its states."""
    nc, stop = await connected(url), asyncio.Event()
    async with Heartbeats(nc) as heartbeats:
        task = asyncio.create_task(work(Options(url, "w1", checkpoint_s=1.0), stop))
        try:
            yield
            await heartbeats.until(lambda last: "w1" in last and last["w1"].samples >= samples)
        finally:
            stop.set()
            await task
            await nc.close()


async def send(nc: Client, pack: str, batch: bytes) -> None:
    """Publish a batch, and wait until the server has stored it."""
    await nc.jetstream().publish(subjects.telemetry(pack), batch, timeout=LONG_S)


async def states(nc: Client, registry: PackRegistry, *packs: str) -> list[bytes]:
    """Return the records of the packs' estimators from the last checkpoints."""
    partitions = await end_states(nc, registry, PARTITIONS)
    found = [partitions[subjects.partition_of(pack, PARTITIONS)].state(pack) for pack in packs]
    return [state["estimator"].tobytes() for state in found if state is not None]


def of_one_run(registry: PackRegistry, pack: str, rows: SampleBlock) -> bytes:
    """Return the record of an estimator after one run over samples, with times since the first of them."""
    estimator = make_estimator(*registry(pack))
    rows = rows.copy()
    rows["time_s"] -= START_S
    estimator.run(rows)
    return estimator.record.tobytes()


async def test_states_from_overlapping_repeated_and_unsorted_batches_are_those_of_one_run(
    cluster: NatsCluster, tmp_path: Path
) -> None:
    nc = await connected(cluster.url)
    await make_streams(nc, partitions=PARTITIONS)
    registry = await load_packs(nc, ["p1"])
    rows = samples_of("p1", COUNT)
    async with running_ingest(tmp_path, cluster.url) as ingest:
        await ingest.logged("ingested")
        async with worker(cluster.url, COUNT):
            await send(nc, "p1", json_batch(rows[:100]))
            await send(nc, "p1", json_batch(rows[:100]))
            await send(nc, "p1", json_batch(rows[50:200][::-1]))
            await send(nc, "p1", json_batch(np.concatenate([rows[200:], rows[200:210]])))
            await ingest.logged("samples of a batch are not stored")
            assert await ingest.end() == 0
    assert (await states(nc, registry, "p1")) == [of_one_run(registry, "p1", rows)]
    await nc.close()
