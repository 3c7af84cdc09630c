"""How what runs long ends: by a signal, or by the first of their tasks."""

import asyncio
import signal
from collections.abc import Coroutine
from typing import Any


def stop_on_signal(stop: asyncio.Event | None = None) -> asyncio.Event:
    """An event, ``stop`` where it is given, that SIGINT and SIGTERM set in place of ending the process.

    SIGHUP, too, as when the terminal is closed, unless somebody handles or ignores it.
    """
    stop = stop or asyncio.Event()
    unheard = [signal.SIGHUP] if signal.getsignal(signal.SIGHUP) is signal.SIG_DFL else []
    for number in (signal.SIGINT, signal.SIGTERM, *unheard):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    return stop


async def until_first_ends(*coroutines: Coroutine[Any, Any, Any]) -> None:
    """Run all until one ends, end the others, raise what one raised."""
    tasks = [asyncio.ensure_future(coroutine) for coroutine in coroutines]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        results = await asyncio.gather(*tasks, return_exceptions=True)
    for result in results:
        if isinstance(result, Exception):
            raise result
