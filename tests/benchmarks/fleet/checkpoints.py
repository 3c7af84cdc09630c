"""Benchmark of the checkpoints of one partition on a real server: bytes and CPU time of a save, by the fraction of changed packs."""

import asyncio
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import nats
import numpy as np
import psutil

from bms_estimator.fleet.nats.streams import make_streams
from bms_estimator.fleet.worker.checkpoint.checkpoint_format import FORMAT, PartitionCheckpoint
from bms_estimator.fleet.worker.checkpoint.checkpoint_store import open_checkpoints
from bms_estimator.fleet.worker.partition import Partition
from tests.benchmarks.fleet.partition import CELL_MODEL, MINUTES, SAMPLES, SETTINGS, encoded_block
from tests.benchmarks.load import pulses
from tests.benchmarks.table import Row
from tests.fleet.nats_cluster import running

PACKS = 1500
"""Number of packs: those of one of 64 partitions of about 100,000 packs."""
SAVES = 50
"""Number of measured saves, after a whole checkpoint."""
CHANGED_FRACTIONS = (1.0, 0.05, 0.01)
"""Fractions of the packs that are changed between two saves."""


def rows() -> Iterator[Row]:
    """Measure the mean save of each fraction of changed packs, which are chosen at random for each save."""
    checkpoint = _checkpoint()
    for fraction in CHANGED_FRACTIONS:
        size, worker_s, server_s = asyncio.run(_measure(checkpoint, fraction))
        measured = f"{size / 1e6:.2f} MB, worker {1e3 * worker_s:.0f} ms, server {1e3 * server_s:.0f} ms"
        yield Row(f"a checkpoint of {PACKS} packs, {fraction:.0%} of them changed", "-", measured, None)


def _checkpoint() -> PartitionCheckpoint:
    """Return the checkpoint of packs with the state of one pack after its first blocks."""
    samples = pulses(MINUTES * SAMPLES, rate_hz=1)
    partition = Partition(0, lambda _: (SETTINGS, CELL_MODEL))
    for minute in range(MINUTES):
        partition.take("pack", encoded_block(samples, minute), minute + 1)
    snapshot = partition.snapshot()
    return replace(snapshot, packs={f"pack{number}": snapshot.packs["pack"] for number in range(PACKS)})


async def _measure(checkpoint: PartitionCheckpoint, fraction: float) -> tuple[float, float, float]:
    """Return the mean size [bytes] and CPU time of worker and server [s] of a save."""
    rng, packs = np.random.default_rng(1), list(checkpoint.packs)
    with tempfile.TemporaryDirectory() as folder, running(Path(folder), partitions=1) as cluster:
        async with await nats.connect(cluster.url) as nc:
            await make_streams(nc, partitions=1)
            store = await open_checkpoints(nc, "benchmark")
            claim = await store.write(await store.claim(0), checkpoint, file_format=FORMAT)
            size, worker_s, server_s = 0, -time.process_time(), -_cpu_s(cluster.pid(0))
            for sequence in range(SAVES):
                changed = rng.choice(packs, round(fraction * PACKS), replace=False).tolist()
                before, save = claim.pointer.kept[0], replace(checkpoint, sequence=sequence, changed=changed)
                claim = await store.write(claim, save, file_format=FORMAT)
                last = claim.pointer.kept[0]
                size += last.increment_bytes - before.increment_bytes if last.increments else last.bytes
            worker_s, server_s = worker_s + time.process_time(), server_s + _cpu_s(cluster.pid(0))
    return size / SAVES, worker_s / SAVES, server_s / SAVES


def _cpu_s(pid: int) -> float:
    times = psutil.Process(pid).cpu_times()
    return times.user + times.system
