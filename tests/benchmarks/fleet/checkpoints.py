"""Benchmark of the checkpoints of one partition on a real server, by the fraction of changed packs.

It measures bytes and CPU time of a save, and the CPU time in which another worker restores the partition.
"""

import asyncio
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import nats
import numpy as np
import psutil

from bms_estimator.fleet.nats.streams import make_streams
from bms_estimator.fleet.worker.checkpoint.checkpoint_format import PartitionCheckpoint
from bms_estimator.fleet.worker.checkpoint.checkpoint_store import open_checkpoints
from bms_estimator.fleet.worker.checkpoint.format_versions import FORMAT
from bms_estimator.fleet.worker.partition import Partition
from tests.benchmarks.fleet.partition import CELL_MODEL, MINUTES, SAMPLES, SETTINGS, encoded_block
from tests.benchmarks.load import pulses
from tests.benchmarks.table import Row
from tests.fleet.nats_cluster import running

PACKS = 1500
"""Number of packs: those of one of 64 partitions of about 100,000 packs."""
SAVES = 65
"""Number of measured saves, after a whole checkpoint. With 1 % of the packs changed, the last one is the 32nd increment."""
CHANGED_FRACTIONS = (1.0, 0.05, 0.01)
"""Fractions of the packs that are changed between two saves."""


@dataclass(frozen=True)
class Measurement:
    """Mean size [bytes] and CPU time [s] of a save; CPU time of the restore [s] and its number of increments."""

    save_bytes: float
    worker_s: float
    server_s: float
    restore_s: float
    increments: int


def rows() -> Iterator[Row]:
    """Measure each fraction of changed packs."""
    checkpoint = simulated_checkpoint()
    for fraction in CHANGED_FRACTIONS:
        m = asyncio.run(_measure(checkpoint, fraction))
        what = f"a checkpoint of {PACKS} packs, {fraction:.0%} of them changed"
        save = f"{m.save_bytes / 1e6:.2f} MB, worker {1e3 * m.worker_s:.0f} ms, server {1e3 * m.server_s:.0f} ms"
        yield Row(what, "-", save, None)
        yield Row(f"  restore, {m.increments} increments", "-", f"{1e3 * m.restore_s:.0f} ms", None)


def simulated_checkpoint() -> PartitionCheckpoint:
    """Return the checkpoint of packs with the state of one pack after its first blocks."""
    samples = pulses(MINUTES * SAMPLES, rate_hz=1)
    partition = Partition(0, lambda _: (SETTINGS, CELL_MODEL))
    for minute in range(MINUTES):
        partition.take("pack", encoded_block(samples, minute), minute + 1)
    snapshot = partition.snapshot()
    return replace(snapshot, packs={f"pack{number}": snapshot.packs["pack"] for number in range(PACKS)})


async def _measure(checkpoint: PartitionCheckpoint, fraction: float) -> Measurement:
    """Write ``SAVES`` checkpoints, between which packs are changed at random, and restore the last one."""
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
            restore_s = -time.process_time()
            Partition.restore(0, lambda _: None, await store.read(claim.pointer.kept[0]))
            restore_s += time.process_time()
    return Measurement(size / SAVES, worker_s / SAVES, server_s / SAVES, restore_s, len(last.increments))


def _cpu_s(pid: int) -> float:
    times = psutil.Process(pid).cpu_times()
    return times.user + times.system
