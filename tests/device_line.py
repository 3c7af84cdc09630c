"""Simulated device that runs in a thread while a test uses its line."""

import asyncio
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from bms_estimator.simulation.simulated_meter import SimulatedMeter
from tests.patience import LONG_S


@contextmanager
def running_device(device: SimulatedMeter) -> Iterator[str]:
    """Run a device in the event loop of a new thread; yield the path of its line."""

    async def run_until_stopped() -> None:
        nonlocal loop, stop
        loop, stop = asyncio.get_running_loop(), asyncio.Event()
        running = asyncio.create_task(device.run())
        ready.set()
        await stop.wait()
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)

    ready = threading.Event()
    # Placeholders: ``run_until_stopped`` replaces both before it sets ``ready``.
    loop, stop = asyncio.new_event_loop(), asyncio.Event()
    loop.close()
    with device:
        thread = threading.Thread(target=lambda: asyncio.run(run_until_stopped()))
        thread.start()
        assert ready.wait(LONG_S)
        try:
            yield device.path
        finally:
            loop.call_soon_threadsafe(stop.set)
            thread.join(LONG_S)
