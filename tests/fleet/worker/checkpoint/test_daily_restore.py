"""``fleet checkpoints`` on the real server: list of the days, and return to a day with and without the later blocks."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import numpy as np
import pytest
from nats.aio.client import Client

from bms_estimator.edge.block import Block, encode
from bms_estimator.estimator.estimator import make_estimator
from bms_estimator.fleet.packs.pack_registry import PackRegistry
from bms_estimator.fleet.worker.checkpoint.checkpoint_format import FORMAT
from bms_estimator.fleet.worker.worker import Options, work
from tests.command_line import run
from tests.fleet.checkpoints import DAY_S, Clock, damage, raw
from tests.fleet.nats_cluster import NatsCluster
from tests.fleet.partition_stream import estimates_of
from tests.fleet.workers import STORE_ID_NS, Heartbeats, block, end_states, estimated, load_packs, samples, send

DAY = "2026-09-21"
"""UTC day of the clock at the begin of a test."""


@pytest.fixture(autouse=True)
def noon(clock: Clock) -> None:
    """Set the clock of all checkpoints."""


@asynccontextmanager
async def worker(cluster: NatsCluster) -> AsyncIterator[None]:
    """Run a worker, which saves its partition at the end."""
    stop = asyncio.Event()
    task = asyncio.create_task(work(Options(cluster.url, "w"), stop))
    yield
    stop.set()
    await task


async def until_blocks(heartbeats: Heartbeats, blocks: int) -> None:
    """Wait until the partition has processed a number of blocks."""
    await heartbeats.until(lambda last: "w" in last and last["w"].counters.get("blocks") == blocks)


async def checkpoints(capsys: pytest.CaptureFixture[str], cluster: NatsCluster, *command: str) -> tuple[int, str, str]:
    """Run ``fleet checkpoints``. Return exit code, stdout and stderr."""
    return await asyncio.to_thread(run, capsys, "fleet", "checkpoints", *command, "--server", cluster.url)


async def state_of(nc: Client, registry: PackRegistry) -> bytes:
    """Return the estimator's state of the pack p1 in the last checkpoint."""
    state = (await end_states(nc, registry, 1))[0].state("p1")
    assert state is not None
    return estimates_of(state["estimator"])


async def save_two_days(
    nc: Client, cluster: NatsCluster, heartbeats: Heartbeats, clock: Clock, registry: PackRegistry
) -> None:
    """Save the pack p1 after two blocks, and a day later after four."""
    for number in (1, 3):
        async with worker(cluster):
            await send(nc, "p1", block("p1", number))
            await send(nc, "p1", block("p1", number + 1))
            await until_blocks(heartbeats, number + 1)
        clock.now_s += DAY_S
    assert await state_of(nc, registry) == estimated(registry, "p1", 4)


async def test_days_and_the_checkpoints_of_a_partition_are_listed(nc, cluster, store, clock, capsys) -> None:
    assert (await checkpoints(capsys, cluster, "list"))[1].endswith("none\n")
    claim, other = await store.claim(0), await store.claim(1)
    for sequence in (1, 2, 3):
        claim = await store.write(claim, raw(sequence, b"1" * 1_500_000), file_format=FORMAT)
        clock.now_s += DAY_S / 2
    await store.write(other, raw(1, b"1" * 500_000), file_format=FORMAT)
    code, out, err = await checkpoints(capsys, cluster, "list")
    assert (code, err) == (0, "")
    assert [line.split() for line in out.splitlines()[3:5]] == [["2026-09-22", "1", "1.5"], [DAY, "1", "1.5"]]
    code, out, _ = await checkpoints(capsys, cluster, "list", "--partition", "0")
    assert [line.split()[0] for line in out.splitlines()[3:7]] == ["last", "previous", "daily", "daily"]


async def test_workers_process_the_later_blocks_again_after_the_return_to_a_day(
    nc, cluster, heartbeats, clock, capsys
) -> None:
    registry = await load_packs(nc, ["p1"])
    await save_two_days(nc, cluster, heartbeats, clock, registry)
    code, out, err = await checkpoints(capsys, cluster, "restore", "--day", DAY)
    assert (code, err) == (0, "")
    assert out.endswith(f"partition 0: returned to the checkpoint of {DAY} 12:00:00 UTC\n")
    assert await state_of(nc, registry) == estimated(registry, "p1", 2)
    async with worker(cluster):
        heartbeats.clear()
        await until_blocks(heartbeats, 4)
    assert await state_of(nc, registry) == estimated(registry, "p1", 4)


async def test_later_blocks_are_skipped_if_desired_although_a_worker_holds_the_partition(
    nc, cluster, heartbeats, clock, capsys
) -> None:
    registry = await load_packs(nc, ["p1"])
    await save_two_days(nc, cluster, heartbeats, clock, registry)
    async with worker(cluster):
        heartbeats.clear()
        await until_blocks(heartbeats, 4)
        code, _, err = await checkpoints(capsys, cluster, "restore", "--day", DAY, "--skip-blocks")
        assert (code, err) == (0, "")
        await send(
            nc, "p1", encode(Block(STORE_ID_NS, 5, 5, 1.79e9, samples("p1", 5)))
        )  # the edge has deleted the others
        await until_blocks(heartbeats, 3)
        assert heartbeats.last["w"].counters["lost_blocks"] == 2
    estimator = make_estimator(*registry("p1"))
    estimator.run(np.concatenate([samples("p1", number) for number in (1, 2, 5)]))
    assert await state_of(nc, registry) == estimates_of(estimator.record)


async def test_nothing_is_changed_without_a_readable_checkpoint_of_the_day(nc, cluster, store, clock, capsys) -> None:
    claim = await store.write(await store.claim(0), raw(1, b"1"), file_format=FORMAT)
    clock.now_s += DAY_S
    claim = await store.write(claim, raw(2, b"2"), file_format=FORMAT)
    for day, partition in (("2026-09-20", "0"), (DAY, "3")):
        code, out, err = await checkpoints(capsys, cluster, "restore", "--day", day, "--partition", partition)
        assert (code, out) == (2, "")
        assert f"{day}: no checkpoint of this day; there are those of {DAY}, 2026-09-22" in err
    assert await store.claims.confirm(claim) == claim
    await damage(nc, claim.pointer.daily[1].object)
    code, out, err = await checkpoints(capsys, cluster, "restore", "--day", DAY)
    assert (code, out) == (2, "")
    assert "partition 0: a checkpoint of 0 bytes is damaged" in err
    assert (await store.claim(0)).pointer.kept == claim.pointer.kept
