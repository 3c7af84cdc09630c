"""Worker in the process of a test, and the states that it saves."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from nats.aio.client import Client

from bms_estimator.edge import subjects
from bms_estimator.fleet.packs.pack_registry import PackRegistry
from bms_estimator.fleet.worker.worker import Options, work
from bms_estimator.model.arrays import SampleBlock
from tests.fleet.ingest.platform import START_S
from tests.fleet.nats_cluster import connected
from tests.fleet.partition_stream import estimates_of
from tests.fleet.workers import Heartbeats, end_states, record_of_run

PARTITIONS = 2


@asynccontextmanager
async def worker(url: str, samples: int) -> AsyncIterator[None]:
    """Run a worker in this process until it has processed ``samples`` samples; then stop it, so that it saves its states.

    Repeated samples are not counted.
    """
    nc, stop = await connected(url), asyncio.Event()
    async with Heartbeats(nc) as heartbeats:
        task = asyncio.create_task(work(Options(url, "w1", checkpoint_s=1.0), stop))
        try:
            yield
            await heartbeats.until(lambda last: "w1" in last and last["w1"].counters.get("samples", 0) >= samples)
        finally:
            stop.set()
            await task
            await nc.close()


async def states(nc: Client, registry: PackRegistry, *packs: str) -> list[bytes]:
    """Return the records of the packs' estimators from the last checkpoints."""
    partitions = await end_states(nc, registry, PARTITIONS)
    found = [partitions[subjects.partition_of(pack, PARTITIONS)].state(pack) for pack in packs]
    return [estimates_of(state["estimator"]) for state in found if state is not None]


def of_one_run(registry: PackRegistry, pack: str, rows: SampleBlock) -> bytes:
    """Return the record of an estimator after one run over samples, with times since the first of them."""
    rows = rows.copy()
    rows["time_s"] -= START_S
    return record_of_run(registry, pack, rows)
