"""Benchmark of ``fleet ingest``: rate and CPU time, from batches that wait on the server to blocks in the stream.

``python -m tests.benchmarks.fleet.ingest --packs 10000`` prints a line for JSON and one for Arrow, and then the longest time for
which a batch of 50,000 blocks stops the other tasks.
"""

import argparse
import asyncio
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import psutil
from nats.aio.client import Client

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.streams import make_streams, make_telemetry_stream
from bms_estimator.model.sample import SampleBlock
from tests.benchmarks.load import pulses
from tests.fleet.ingest.platform import (
    START_S,
    arrow_batch,
    ingesting,
    json_batch,
    running_ingest,
    select,
    until_stored,
)
from tests.fleet.nats_cluster import connected, running
from tests.fleet.workers import load_packs, until

SAMPLES = 60
"""Number of samples of a batch and of a block, at 1 Hz."""
BATCHES = 4
"""Number of batches of a pack. The first sample of each batch completes the block of the previous one."""
POLL_S = 0.05
"""Poll interval of the stream [s]."""
IN_FLIGHT = 1000
"""Maximum number of batches without an acknowledgment."""
BLOCKS = 50_000
"""Number of blocks of the large batch, which has one sample a minute."""


async def measure(folder: Path, packs: int, encode: Callable[[SampleBlock], bytes]) -> str:
    """Return the result for one format as text."""
    rows = pulses(BATCHES * SAMPLES, rate_hz=1)
    rows["time_s"] = START_S + np.arange(rows.size)
    for name in ("current_a", "voltage_v"):
        rows[name] = rows[name].round(3)
    batches = [encode(part) for part in np.split(rows, BATCHES)]
    with running(folder) as cluster:
        nc = await connected(cluster.url)
        await make_streams(nc, raw_bytes=1 << 30)
        await make_telemetry_stream(nc, 2 << 30)
        names = [f"pack{number:06d}" for number in range(packs)]
        await load_packs(nc, names)
        await send(nc, names, batches)
        async with running_ingest(folder, cluster.url, "--buffer-gb", 2) as ingest:
            process = psutil.Process(ingest.process.pid)
            begin = await wait_for_blocks(nc, process, 1)
            end = await wait_for_blocks(nc, process, packs * (BATCHES - 1))
            memory = process.memory_info().rss / (1 << 20)
        await nc.close()
    blocks, wall_s, cpu_s = (after - before for before, after in zip(begin, end, strict=True))
    return (
        f"{len(batches[0]):,} bytes a batch, {SAMPLES * blocks / wall_s:,.0f} samples/s, "
        f"{1e6 * cpu_s / blocks / SAMPLES:.1f} us of CPU a sample, {1e3 * cpu_s / blocks:.2f} ms a batch, {memory:.0f} MiB"
    )


async def send(nc: Client, packs: list[str], batches: list[bytes]) -> None:
    """Publish the batches of all packs, as a platform does: the first batch of each pack, then the second ones."""
    js = nc.jetstream()
    messages = [(subjects.telemetry(pack), batch) for batch in batches for pack in packs]
    for first in range(0, len(messages), IN_FLIGHT):
        await asyncio.gather(*[await js.publish_async(*message) for message in messages[first : first + IN_FLIGHT]])


async def wait_for_blocks(nc: Client, process: psutil.Process, count: int) -> tuple[int, float, float]:
    """Wait for a number of blocks in the stream. Return their number, the time [s] and the CPU time of the process [s]."""
    js = nc.jetstream()
    while (blocks := (await js.stream_info(subjects.RAW_STREAM)).state.messages) < count:  # noqa: ASYNC110 - the stream sends no notification
        await asyncio.sleep(POLL_S)
    return blocks, time.monotonic(), sum(process.cpu_times()[:2])


async def measure_holds(folder: Path) -> str:
    """Return the longest times between two iterations of the event loop while a batch of ``BLOCKS`` blocks is processed."""
    times_s = START_S - 60 * np.arange(BLOCKS, 0, -1)
    ones = ",".join(["1"] * BLOCKS)
    batch = f'{{"time_s":[{",".join(map(str, times_s.astype(int)))}],"current_a":[{ones}],"voltage_v":[{ones}]}}'
    holds_s = list[float]()

    async def record_holds() -> None:
        last_s = time.monotonic()
        while True:
            await asyncio.sleep(0)
            now_s = time.monotonic()
            holds_s.append(now_s - last_s)
            last_s = now_s

    with running(folder) as cluster:
        nc = await connected(cluster.url)
        await make_streams(nc, partitions=1)
        await load_packs(nc, ["p1"])
        async with ingesting(folder, cluster.url):
            await until(lambda: select(folder, "SELECT sequence FROM progress"), lambda: "not started")
            recording = asyncio.create_task(record_holds())
            await nc.jetstream().publish(subjects.telemetry("p1"), batch.encode())
            await until_stored(folder, BLOCKS - 1)
            recording.cancel()
        await nc.close()
    return ", ".join(f"{1e3 * hold_s:.0f}" for hold_s in sorted(holds_s)[-3:]) + " ms"


def main() -> None:
    """Measure both formats, and a large batch."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--packs", type=int, default=10_000)
    packs = parser.parse_args().packs
    for name, encode in (("JSON", json_batch), ("Arrow", arrow_batch)):
        with tempfile.TemporaryDirectory() as folder:
            sys.stdout.write(f"{name}: {asyncio.run(measure(Path(folder), packs, encode))}\n")
    with tempfile.TemporaryDirectory() as folder:
        sys.stdout.write(f"{BLOCKS:,} blocks: longest holds {asyncio.run(measure_holds(Path(folder)))}\n")


if __name__ == "__main__":
    main()
