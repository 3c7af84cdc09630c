"""Disk of the server that is lost while a worker lives: the worker saves its states and the table of packs on the new disk."""

import asyncio
import shutil
from pathlib import Path

from nats.aio.client import Client

from bms_estimator.fleet.nats.checkpoint_pointer import CheckpointPointer
from bms_estimator.fleet.nats.streams import make_streams
from bms_estimator.fleet.worker.checkpoint.admin_changes import read_pointers
from tests.fleet.nats_cluster import connected, running
from tests.fleet.partition_stream import estimates_of
from tests.fleet.workers import (
    PACK_ROW,
    Heartbeats,
    Process,
    block,
    end_states,
    estimated,
    load_packs,
    send,
    until_table,
)
from tests.patience import LONG_S

BLOCKS = 4
"""Number of blocks before the loss, and after it."""


async def test_worker_fills_the_buckets_of_a_new_disk_with_its_states_and_the_table_of_packs(tmp_path: Path) -> None:
    with running(tmp_path, partitions=1) as cluster:
        nc = await connected(cluster.url)
        await make_streams(nc, partitions=1)
        registry = await load_packs(nc, ["p1"])
        worker = Process(tmp_path, cluster.url, "w1", "--checkpoint-s", 1)
        try:
            async with Heartbeats(nc) as heartbeats:
                for number in range(1, BLOCKS + 1):
                    await send(nc, "p1", block("p1", number))
                await heartbeats.until(lambda last: "w1" in last and last["w1"].counters.get("blocks") == BLOCKS)
                await heartbeats.until(lambda last: last["w1"].unsaved_s == 0.0)
                cluster.kill(0)
                shutil.rmtree(tmp_path / "n0")
                cluster.start(0)
                await make_streams(nc, partitions=1)
                await _until_saved(nc)
                await until_table(nc, {"p1": PACK_ROW})
                for number in range(BLOCKS + 1, 2 * BLOCKS + 1):
                    await send(nc, "p1", block("p1", number))
                await heartbeats.until(lambda last: last["w1"].counters.get("blocks") == 2 * BLOCKS)
            assert await worker.end() == 0
        finally:
            worker.kill()
        state = (await end_states(nc, registry, 1))[0].state("p1")
        assert state is not None
        assert estimates_of(state["estimator"]) == estimated(registry, "p1", 2 * BLOCKS)
        await nc.close()


async def _until_saved(nc: Client) -> None:
    """Wait until the pointer of the partition names a checkpoint."""
    async with asyncio.timeout(LONG_S):
        while not (await read_pointers(nc)).get(0, CheckpointPointer()).kept:  # noqa: ASYNC110 - the server is asked
            await asyncio.sleep(0.1)
