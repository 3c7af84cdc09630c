"""Benchmark of twenty packs in one service, with boards on pseudo-terminals and Mosquitto, each as a process."""

import asyncio
import contextlib
import json
import signal
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import aiomqtt
import psutil

from tests.benchmarks.speed.live import (
    MEASURE_S,
    PATIENCE_S,
    PROGRAM,
    SETTLE_S,
    TimedBoard,
    pack_file,
)
from tests.benchmarks.table import Row
from tests.mosquitto import MOSQUITTO, Broker

PACKS, RATE_HZ, PUBLISH_RATE_HZ = 20, 10, 1.0
MAX_CPU, MAX_MIB = 0.25, 400.0
"""Limits of CPU time, as a fraction of a core, and of resident memory [MiB]."""


def rows() -> Iterator[Row]:
    """Measure CPU time and memory of a process that serves twenty packs."""
    if MOSQUITTO is None:
        yield Row(f"{PACKS} packs", "-", "mosquitto is not installed", None)
        return
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        server = stack.enter_context(Broker(folder))
        boards = [stack.enter_context(TimedBoard(RATE_HZ)) for _ in range(PACKS)]
        cpu, health = asyncio.run(_measure(folder, boards, server))
    online = sum(h["sensor_online"] for h in health.values())
    rss_mib, lag_s = (max(h[name] for h in health.values()) for name in ("rss_mib", "loop_lag_s"))
    yield Row(f"{PACKS} packs at {RATE_HZ} Hz in one process", "all live", f"{online} live", online == PACKS)
    yield Row("  its processor time", f"below {MAX_CPU:.0%} of a core", f"{cpu:.1%}", cpu < MAX_CPU)
    yield Row("  its memory", f"below {MAX_MIB:.0f} MiB", f"{rss_mib:.0f} MiB", rss_mib < MAX_MIB)
    yield Row("  its loop's lag (the machine's)", "-", f"{1e3 * lag_s:.1f} ms", None)


async def _measure(folder: Path, boards: list[TimedBoard], server: Broker) -> tuple[float, dict[str, Any]]:
    """Measure the service once all packs are live. Return its CPU time as a fraction of a core, and the last health messages."""
    packs = [
        pack_file(folder, f"pack{i}", board.path, RATE_HZ, server, PUBLISH_RATE_HZ) for i, board in enumerate(boards)
    ]
    running = [asyncio.create_task(board.run_for_host()) for board in boards]
    health: dict[str, Any] = {}
    all_live = asyncio.Event()
    async with aiomqtt.Client("127.0.0.1", server.port) as client:
        await client.subscribe("bms/+/health")
        listening = asyncio.create_task(_listen(client, health, all_live))
        with (folder / "log").open("w") as log:
            service = await asyncio.create_subprocess_exec(PROGRAM, "run", *packs, stdout=log, stderr=log)
        try:
            await asyncio.wait_for(all_live.wait(), PACKS * PATIENCE_S)
            await asyncio.sleep(SETTLE_S)
            process, begin_s = psutil.Process(service.pid), time.monotonic()
            before_s = sum(process.cpu_times()[:2])
            await asyncio.sleep(MEASURE_S)
            cpu = (sum(process.cpu_times()[:2]) - before_s) / (time.monotonic() - begin_s)
            measured = dict(health)
        finally:
            service.send_signal(signal.SIGINT)
            await asyncio.wait_for(service.wait(), PATIENCE_S)
            for task in (listening, *running):
                task.cancel()
    return cpu, measured


async def _listen(client: aiomqtt.Client, health: dict[str, Any], all_live: asyncio.Event) -> None:
    """Store the last health message by topic, and set ``all_live`` once every sensor is online."""
    async for message in client.messages:
        health[message.topic.value] = json.loads(message.payload)
        if sum(h["sensor_online"] for h in health.values()) == PACKS:
            all_live.set()
