"""Benchmark of the fleet page: CPU, memory and traffic with 100,000 packs that report once a minute (1,667 states/s).

``make fleet-page`` runs it. A real nats-server and the page as a process are used, with one simulated browser. This process
publishes the states.
"""

import argparse
import asyncio
import contextlib
import json
import sys
import tempfile
import time
from pathlib import Path

import aiohttp
import nats
import psutil
from nats.aio.client import Client

from bms_estimator.fleet.nats.streams import make_streams
from tests.fleet.nats_cluster import running
from tests.fleet.published_states import load, make_packs, publish, publish_heartbeat
from tests.free_port import free_port
from tests.page.house import start_program

MINUTE_S = 60.0
SETTLE_S = 1.5 * MINUTE_S
"""Time until each pack has been published at least once [s]."""
TICK_S = 0.05
"""Interval at which due states are published [s]."""


def print_line(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


async def publish_fleet(nc: Client, packs: int) -> None:
    """Publish the state of every pack once a minute, evenly spread, and the heartbeats of two workers, until cancelled."""
    fleet, sent_count, begin_s, heartbeat_s = make_packs(packs), 0, time.monotonic(), 0.0
    while True:
        now_s = time.monotonic()
        while sent_count < packs * (now_s - begin_s) / MINUTE_S:
            pack = fleet[sent_count % packs]
            await publish(nc, pack.name, pack.state)
            sent_count += 1
        if now_s > heartbeat_s + 1.0:
            heartbeat_s = now_s
            for name, partitions in (("alpha", range(32)), ("beta", range(32, 64))):
                await publish_heartbeat(
                    nc, name, partitions, packs=packs // 2, blocks=sent_count // 2, samples=30 * sent_count, lag_s=0.4
                )
        await asyncio.sleep(TICK_S)


async def read_events(url: str, received: dict[str, float]) -> None:
    """Read the event stream as a browser does, and count events and bytes in ``received``."""
    async with (
        aiohttp.ClientSession(timeout=aiohttp.ClientTimeout()) as session,
        session.get(f"{url}/events") as events,
    ):
        async for line in events.content:
            if line.startswith(b"data: "):
                received["events"] = received.get("events", 0) + 1
                received["bytes"] = received.get("bytes", 0) + len(line)
                fleet = json.loads(line.removeprefix(b"data: ")).get("fleet")
                if fleet:
                    received["alive"], received["states_per_s"] = fleet["packs"]["alive"], fleet["states_per_s"] or 0.0


async def measure(packs: int, minutes: float) -> None:
    """Publish the states of ``packs`` packs; after ``SETTLE_S`` measure the process of the page for ``minutes``."""
    with tempfile.TemporaryDirectory() as temporary, running(Path(temporary)) as cluster:
        nc = await nats.connect(cluster.url)
        await make_streams(nc)
        await load(nc, make_packs(packs))
        port = free_port()
        arguments = ("--server", cluster.url, "--listen", f"127.0.0.1:{port}", "--no-browser")
        page = await start_program(Path(temporary), "fleet", "page", *arguments, port=port)
        process, received = psutil.Process(page.pid), dict[str, float]()
        tasks = [
            asyncio.create_task(publish_fleet(nc, packs)),
            asyncio.create_task(read_events(f"http://127.0.0.1:{port}", received)),
        ]
        await asyncio.sleep(SETTLE_S)
        cpu_before, begin_s, received_before = process.cpu_times(), time.monotonic(), dict(received)
        await asyncio.sleep(MINUTE_S * minutes)
        cpu_after, elapsed_s = process.cpu_times(), time.monotonic() - begin_s
        cpu = (cpu_after.user + cpu_after.system - cpu_before.user - cpu_before.system) / elapsed_s
        print_line(
            f"{packs} packs, {received['states_per_s']:.0f} states/s received, {received['alive']:.0f} alive, over {elapsed_s:.0f} s"
        )
        print_line(
            f"page's process: {100.0 * cpu:.1f} % of a core, {process.memory_info().rss / 2**20:.0f} MiB resident"
        )
        events = received["events"] - received_before["events"]
        print_line(
            f"to a browser: {events / elapsed_s:.2f} events/s of {(received['bytes'] - received_before['bytes']) / events / 1e3:.1f} kB"
        )
        for task in tasks:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
        page.terminate()
        await page.wait()
        await nc.close()


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--packs", type=int, default=100_000)
    parser.add_argument("--minutes", type=float, default=2.0)
    options = parser.parse_args()
    asyncio.run(measure(options.packs, options.minutes))
