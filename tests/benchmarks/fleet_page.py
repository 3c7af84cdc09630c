"""Cost of the page of a fleet: 100,000 packs in minute blocks are 1,667 states/s; ``make fleet-page``.

The real nats-server; the page as its command serves it, with one browser's stream of events; states from this process.
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
TICK_S = 0.05


def say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


async def send(nc: Client, packs: int) -> None:
    """Publish all packs once a minute, evenly, and two workers, until cancelled."""
    fleet, sent, begin_s, beaten_s = make_packs(packs), 0, time.monotonic(), 0.0
    while True:
        now_s = time.monotonic()
        while sent < packs * (now_s - begin_s) / MINUTE_S:
            pack = fleet[sent % packs]
            await publish(nc, pack.name, pack.state)
            sent += 1
        if now_s > beaten_s + 1.0:
            beaten_s = now_s
            for name, partitions in (("alpha", range(32)), ("beta", range(32, 64))):
                await publish_heartbeat(
                    nc, name, partitions, packs=packs // 2, blocks=sent // 2, samples=30 * sent, lag_s=0.4
                )
        await asyncio.sleep(TICK_S)


async def read(url: str, got: dict[str, float]) -> None:
    """Read the event stream as a browser does."""
    async with (
        aiohttp.ClientSession(timeout=aiohttp.ClientTimeout()) as session,
        session.get(f"{url}/events") as events,
    ):
        async for line in events.content:
            if line.startswith(b"data: "):
                got["events"] = got.get("events", 0) + 1
                got["bytes"] = got.get("bytes", 0) + len(line)
                fleet = json.loads(line[6:]).get("fleet")
                if fleet:
                    got["alive"], got["states_per_s"] = fleet["packs"]["alive"], fleet["states_per_s"] or 0.0


async def measure(packs: int, minutes: float) -> None:
    """Load the table, send for two minutes, then measure the process for ``minutes``."""
    with tempfile.TemporaryDirectory() as temporary, running(Path(temporary)) as cluster:
        nc = await nats.connect(cluster.url)
        await make_streams(nc)
        await load(nc, make_packs(packs))
        port = free_port()
        arguments = ("--server", cluster.url, "--listen", f"127.0.0.1:{port}", "--no-browser")
        page = await start_program(Path(temporary), "fleet", "page", *arguments, port=port)
        process, got = psutil.Process(page.pid), dict[str, float]()
        tasks = [asyncio.create_task(send(nc, packs)), asyncio.create_task(read(f"http://127.0.0.1:{port}", got))]
        await asyncio.sleep(1.5 * MINUTE_S)
        times, begin_s, before = process.cpu_times(), time.monotonic(), dict(got)
        await asyncio.sleep(MINUTE_S * minutes)
        spent, over_s = process.cpu_times(), time.monotonic() - begin_s
        cpu = (spent.user + spent.system - times.user - times.system) / over_s
        say(f"{packs} packs, {got['states_per_s']:.0f} states/s heard, {got['alive']:.0f} alive, over {over_s:.0f} s")
        say(f"page's process: {100.0 * cpu:.1f} % of a core, {process.memory_info().rss / 2**20:.0f} MiB resident")
        events = got["events"] - before["events"]
        say(f"to a browser: {events / over_s:.2f} events/s of {(got['bytes'] - before['bytes']) / events / 1e3:.1f} kB")
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
    given = parser.parse_args()
    asyncio.run(measure(given.packs, given.minutes))
