"""Troubles with storing a partition's data: how long a worker's heartbeat reports them."""

import asyncio
from collections.abc import AsyncIterator

import pytest
from nats.aio.client import Client

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.connection import connect
from bms_estimator.fleet.nats.dead_letters import DeadLetter
from bms_estimator.fleet.nats.streams import make_streams
from bms_estimator.fleet.worker.block_result import LETHAL
from bms_estimator.fleet.worker.worker import Options, Worker, open_stores
from bms_estimator.process.runtime import end_tasks
from bms_estimator.process.systemd import SystemdNotifier
from tests.fleet.nats_cluster import NatsCluster
from tests.fleet.workers import Heartbeats, block, load_packs, send
from tests.patience import LONG_S


@pytest.fixture
async def worker(cluster: NatsCluster, nc: Client, heartbeats: Heartbeats) -> AsyncIterator[Worker]:
    """Yield a worker that has processed a block, without its periodic tasks, and whose last checkpoint has failed."""
    await load_packs(nc, ["p1"])
    await send(nc, "p1", block("p1", 1))
    worker_nc = await connect(cluster.url, "w")
    worker = Worker(worker_nc, Options(cluster.url, "w"), await open_stores(worker_nc, "w"), SystemdNotifier(["w"]))
    running = asyncio.create_task(worker.run())
    await heartbeats.until(lambda last: "w" in last and last["w"].counters.get("blocks") == 1)
    await end_tasks(running)
    await nc.jetstream().delete_stream(f"KV_{subjects.CHECKPOINTS_BUCKET}")
    (lease,) = worker._leases
    lease.checkpoint_due_s = 0.0
    await worker._storage.save([lease])
    assert "could not be stored" in worker._heartbeat().trouble
    yield worker
    await worker.end()


async def test_trouble_of_a_checkpoint_ends_with_the_next_checkpoint_and_not_with_a_sent_letter(
    nc: Client, worker: Worker
) -> None:
    (lease,) = worker._leases
    lease.results.queue_dead_letter(DeadLetter("p1", 1, LETHAL, "w", b""))
    await worker._storage.send_results([lease])
    assert not lease.results.waiting
    assert "could not be stored" in worker._heartbeat().trouble
    await make_streams(nc, partitions=1)
    lease.checkpoint_due_s = 0.0
    await worker._storage.save([lease])
    assert worker._heartbeat().trouble == ""


async def test_trouble_of_a_dead_letter_ends_when_the_save_of_a_checkpoint_sends_the_letter(
    nc: Client, worker: Worker
) -> None:
    (lease,) = worker._leases
    await make_streams(nc, partitions=1)
    await nc.jetstream().delete_stream(subjects.DEAD_STREAM)
    lease.results.queue_dead_letter(DeadLetter("p1", 1, LETHAL, "w", b""))
    await worker._storage.send_results([lease])
    await make_streams(nc, partitions=1)
    lease.checkpoint_due_s = 0.0
    await worker._storage.save([lease])
    await worker._storage.send_results([lease])
    assert (len(lease.results.waiting), worker._heartbeat().trouble) == (0, "")


async def test_trouble_of_a_released_partition_leaves_the_heartbeat(worker: Worker) -> None:
    worker._lease_tasks.start_release(0)
    async with asyncio.timeout(LONG_S):
        while worker._leases:  # noqa: ASYNC110 - the end of a release has no event
            await asyncio.sleep(0.01)
    assert worker._heartbeat().trouble == ""
