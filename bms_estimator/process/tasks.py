"""Reliable cancellation of tasks: some libraries, and wait_for of Python 3.11, may swallow a cancellation."""

import asyncio
from collections.abc import Coroutine
from typing import Any

CANCEL_INTERVAL_S = 0.1
"""Interval at which a task that ignores cancellation is cancelled again [s]."""


async def end(*tasks: asyncio.Future[Any]) -> None:
    """Cancel tasks repeatedly until all have ended. They must not contain work that has to be finished."""
    while unfinished := {task for task in tasks if not task.done()}:
        for task in unfinished:
            task.cancel()
        await asyncio.wait(unfinished, timeout=CANCEL_INTERVAL_S)


async def until_first_ends(*coroutines: Coroutine[Any, Any, Any]) -> None:
    """Run coroutines until one ends, cancel the others, and raise the first exception of any of them."""
    tasks = [asyncio.ensure_future(coroutine) for coroutine in coroutines]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        await end(*tasks)
    for task in tasks:
        if not task.cancelled() and (error := task.exception()):
            raise error
