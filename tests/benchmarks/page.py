"""Cost of the live page in a browser: first paint, CPU and memory at 10 Hz; ``make page ARGS=minutes``.

A real Chromium on the page of the real service, whose pack publishes ten states a second.
"""

import asyncio
import sys
import tempfile
import time
from pathlib import Path

import psutil

from tests.free_port import free_port
from tests.mosquitto import Broker
from tests.page.chromium import chromium, tab
from tests.page.house import Service, simulated

MINUTES = 5.0
SETTLE_S = 20.0
STEP_S = 30.0
MAX_CPU, MAX_PAINT_S, MAX_GROWTH_MIB = 0.15, 1.0, 4.0
FIRST_PAINT = "() => performance.getEntriesByName('first-contentful-paint')[0]?.startTime"


def processes(of: int) -> list[psutil.Process]:
    """Return a process and all its descendants."""
    parent = psutil.Process(of)
    return [parent, *parent.children(recursive=True)]


def cpu_s(of: list[psutil.Process]) -> float:
    """Return the total CPU time of processes [s]."""
    total = 0.0
    for process in of:
        try:
            times = process.cpu_times()
        except psutil.NoSuchProcess:
            continue
        total += times.user + times.system
    return total


def say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


async def measure(service: Service, minutes: float) -> None:
    """Measure one page for ``minutes``."""
    async with chromium() as browser, tab(browser, service.url) as opened:
        await opened.until_status("live")
        await opened.until("() => performance.getEntriesByName('first-contentful-paint').length")
        say(f"first paint {await opened.page.evaluate(FIRST_PAINT) / 1e3:.2f} s (below {MAX_PAINT_S:g} s)")
        session = await opened.page.context.new_cdp_session(opened.page)
        await asyncio.sleep(SETTLE_S)
        own = [p for p in processes(psutil.Process().pid) if "chrom" in p.name()]
        renderers = [p for p in own if "--type=renderer" in p.cmdline()]
        begin_s, all_s, renderer_s, server_s = time.monotonic(), cpu_s(own), cpu_s(renderers), cpu_s(_of(service))
        heaps = []
        while time.monotonic() - begin_s < 60.0 * minutes:
            await asyncio.sleep(STEP_S)
            await session.send("HeapProfiler.collectGarbage")
            heaps.append((await session.send("Runtime.getHeapUsage"))["usedSize"] / 2**20)
        span_s = time.monotonic() - begin_s
        parts = {"renderer": cpu_s(renderers) - renderer_s, "all of Chromium": cpu_s(own) - all_s}
        parts["the service, estimator and all"] = cpu_s(_of(service)) - server_s
        for name, took_s in parts.items():
            say(f"{name}: {took_s / span_s:.1%} of a core over {span_s / 60.0:.1f} min")
        say(f"limit of all of Chromium: {MAX_CPU:.0%}")
        say(f"JavaScript heap: {heaps[0]:.1f} MiB at first, {heaps[-1]:.1f} at last, {max(heaps):.1f} at most")
        say(f"growth allowed: {MAX_GROWTH_MIB:g} MiB")


def _of(service: Service) -> list[psutil.Process]:
    return [psutil.Process(service.process.pid)]


async def main(minutes: float) -> None:
    with tempfile.TemporaryDirectory() as temporary:
        broker = Broker(Path(temporary)).start()
        try:
            async with Service(Path(temporary), broker, free_port(), simulated()) as service:
                await measure(service, minutes)
        finally:
            broker.stop()


if __name__ == "__main__":
    asyncio.run(main(float(sys.argv[1]) if len(sys.argv) > 1 else MINUTES))
