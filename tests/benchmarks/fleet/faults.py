"""Benchmark of faults on a real server: the guarded replay of blocks, the erasure of a pack, and resent blocks."""

import asyncio
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import nats
from nats.aio.client import Client

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.streams import make_streams
from bms_estimator.fleet.worker.checkpoint.checkpoint_store import open_checkpoints
from bms_estimator.fleet.worker.checkpoint.erasure import erase_packs
from bms_estimator.fleet.worker.checkpoint.format_versions import FORMAT
from bms_estimator.fleet.worker.partition import Partition
from bms_estimator.fleet.worker.replay_guard import GUARDED_CLAIMS, ReplayGuard
from tests.benchmarks.fleet.checkpoints import PACKS, simulated_checkpoint
from tests.benchmarks.fleet.partition import CELL_MODEL, MINUTES, SAMPLES, SETTINGS, encoded_block
from tests.benchmarks.load import pulses
from tests.benchmarks.table import Row
from tests.fleet.nats_cluster import running

DAY_BLOCKS, OTHER_BLOCKS = 1440, 14_400
"""Number of blocks of the erased pack, which are those of a day, and of all other packs."""
GUARDED_BLOCKS, REPEATED_BLOCKS = 2000, 20_000
"""Number of blocks of a guarded replay, and of blocks that an edge sends again."""


def rows() -> Iterator[Row]:
    """Measure each fault."""
    guarded_s, erasure_s = asyncio.run(_measure_on_server())
    yield Row("a block of a guarded replay, in addition", "-", f"{1e3 * guarded_s:.2f} ms", None)
    packs = f"a pack with {DAY_BLOCKS:,} blocks erased, among {OTHER_BLOCKS:,} blocks of {PACKS} packs"
    yield Row(packs, "-", f"{erasure_s:.2f} s", None)
    yield Row("a block that the worker already has", "-", f"{1e6 * _repeated_s():.0f} us", None)


async def _measure_on_server() -> tuple[float, float]:
    """Return the additional time of a block in a guarded replay, and the time in which a pack is erased [s]."""
    with tempfile.TemporaryDirectory() as folder, running(Path(folder), partitions=1) as cluster:
        async with await nats.connect(cluster.url) as nc:
            await make_streams(nc, partitions=1)
            return await _guarded_s(nc), await _erasure_s(nc)


async def _guarded_s(nc: Client) -> float:
    store = await open_checkpoints(nc, "benchmark")
    guard = ReplayGuard(store.replays, 0)
    for _ in range(GUARDED_CLAIMS + 1):
        await guard.begin(await store.claim(0), GUARDED_BLOCKS)
    begin_s = time.perf_counter()
    for sequence in range(1, GUARDED_BLOCKS + 1):
        assert guard.is_guarded(sequence)
        await guard.is_lethal(sequence)
        await guard.end_block(sequence)
    return (time.perf_counter() - begin_s) / GUARDED_BLOCKS


async def _erasure_s(nc: Client) -> float:
    block = encoded_block(pulses(SAMPLES, rate_hz=1), 0)
    for number in range(OTHER_BLOCKS):
        await nc.publish(subjects.raw(f"pack{1 + number % (PACKS - 1)}"), block)
        if number % (OTHER_BLOCKS // DAY_BLOCKS) == 0:
            await nc.publish(subjects.raw("pack0"), block)
    await nc.flush()
    store = await open_checkpoints(nc, "benchmark")
    await store.write(await store.claim(0), replace(simulated_checkpoint(), sequence=1), file_format=FORMAT)
    begin_s = time.perf_counter()
    erasure = (await erase_packs(nc, {"pack0"}))["pack0"]
    assert erasure.blocks == DAY_BLOCKS
    return time.perf_counter() - begin_s


def _repeated_s() -> float:
    """Return the CPU time of a block that the partition has already processed [s]."""
    samples = pulses(MINUTES * SAMPLES, rate_hz=1)
    partition, block = Partition(0, lambda _: (SETTINGS, CELL_MODEL)), encoded_block(samples, 0)
    partition.take("pack", block, 1)
    begin_s = time.process_time()
    for sequence in range(2, REPEATED_BLOCKS + 2):
        partition.take("pack", block, sequence)
    return (time.process_time() - begin_s) / REPEATED_BLOCKS
