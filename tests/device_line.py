"""A simulated device that speaks on its line while a test does other things."""

import asyncio
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from bms_estimator.simulation.simulated_meter import SimulatedMeter
from tests.patience import LONG_S


@contextmanager
def on_a_line(device: SimulatedMeter) -> Iterator[str]:
    """Path of the line of a device that speaks, in a thread of its own."""

    async def speak() -> None:
        nonlocal loop, stop
        loop, stop = asyncio.get_running_loop(), asyncio.Event()
        speaking = asyncio.create_task(device.run())
        ready.set()
        await stop.wait()
        speaking.cancel()
        await asyncio.gather(speaking, return_exceptions=True)

    loop, stop, ready = asyncio.new_event_loop(), asyncio.Event(), threading.Event()
    loop.close()
    with device:
        thread = threading.Thread(target=lambda: asyncio.run(speak()))
        thread.start()
        assert ready.wait(LONG_S)
        try:
            yield device.path
        finally:
            loop.call_soon_threadsafe(stop.set)
            thread.join(LONG_S)
