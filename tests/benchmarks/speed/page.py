"""Benchmark of the live page in a browser: first paint, CPU and memory; ``make page ARGS=minutes``.

A real Chromium shows the page of the real service, whose pack publishes ten states a second.
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
"""Time from the first paint to the measurement [s]."""
HEAP_INTERVAL_S = 30.0
"""Interval of the heap measurements [s]."""
MAX_CPU = 0.15
"""Limit of the CPU time of Chromium as a fraction of a core."""
MAX_PAINT_S = 1.0
MAX_GROWTH_MIB = 4.0
"""Limit of the growth of the JavaScript heap [MiB]."""
FIRST_PAINT_MS = "() => performance.getEntriesByName('first-contentful-paint')[0]?.startTime"
"""JavaScript that returns the time of the first paint [ms]."""


def process_tree(pid: int) -> list[psutil.Process]:
    """Return a process and all its descendants."""
    parent = psutil.Process(pid)
    return [parent, *parent.children(recursive=True)]


def cpu_s(processes: list[psutil.Process]) -> float:
    """Return the total CPU time of processes [s]."""
    total = 0.0
    for process in processes:
        try:
            times = process.cpu_times()
        except psutil.NoSuchProcess:
            continue
        total += times.user + times.system
    return total


def print_line(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


async def measure(service: Service, minutes: float) -> None:
    """Show the page of ``service`` in Chromium for ``minutes``, and print first paint, CPU time and heap."""
    async with chromium() as browser, tab(browser, service.url) as page_tab:
        await page_tab.until_status("live")
        await page_tab.until("() => performance.getEntriesByName('first-contentful-paint').length")
        print_line(f"first paint {await page_tab.page.evaluate(FIRST_PAINT_MS) / 1e3:.2f} s (below {MAX_PAINT_S:g} s)")
        session = await page_tab.page.context.new_cdp_session(page_tab.page)
        await asyncio.sleep(SETTLE_S)
        # Chromium is a descendant of this process.
        chromium_processes = [p for p in process_tree(psutil.Process().pid) if "chrom" in p.name()]
        renderers = [p for p in chromium_processes if "--type=renderer" in p.cmdline()]
        begin_s, chromium_before_s, renderer_before_s, service_before_s = (
            time.monotonic(),
            cpu_s(chromium_processes),
            cpu_s(renderers),
            cpu_s(service_processes(service)),
        )
        heaps_mib = []
        while time.monotonic() - begin_s < 60.0 * minutes:
            await asyncio.sleep(HEAP_INTERVAL_S)
            await session.send("HeapProfiler.collectGarbage")
            heaps_mib.append((await session.send("Runtime.getHeapUsage"))["usedSize"] / 2**20)
        elapsed_s = time.monotonic() - begin_s
        cpu_s_by_part = {
            "renderer": cpu_s(renderers) - renderer_before_s,
            "all of Chromium": cpu_s(chromium_processes) - chromium_before_s,
        }
        cpu_s_by_part["the service, estimator and all"] = cpu_s(service_processes(service)) - service_before_s
        for name, used_s in cpu_s_by_part.items():
            print_line(f"{name}: {used_s / elapsed_s:.1%} of a core over {elapsed_s / 60.0:.1f} min")
        print_line(f"limit of all of Chromium: {MAX_CPU:.0%}")
        print_line(
            f"JavaScript heap: {heaps_mib[0]:.1f} MiB at first, {heaps_mib[-1]:.1f} at last, {max(heaps_mib):.1f} at most"
        )
        print_line(f"growth allowed: {MAX_GROWTH_MIB:g} MiB")


def service_processes(service: Service) -> list[psutil.Process]:
    return [psutil.Process(service.process.pid)]


async def main(minutes: float) -> None:
    with tempfile.TemporaryDirectory() as temporary, Broker(Path(temporary)) as broker:
        async with Service(Path(temporary), broker, free_port(), simulated()) as service:
            await measure(service, minutes)


if __name__ == "__main__":
    asyncio.run(main(float(sys.argv[1]) if len(sys.argv) > 1 else MINUTES))
