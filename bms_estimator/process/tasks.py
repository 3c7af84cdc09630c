"""Tasks that talk with the server, and how they end: its library, and wait_for of Python 3.11, may swallow a cancellation."""

import asyncio
from collections.abc import Coroutine
from typing import Any

AGAIN_S = 0.1
"""Interval at which a task that ignores cancellation is cancelled again [s]."""


async def end(*tasks: asyncio.Future[Any]) -> None:
    """Cancel until all have ended; nothing that must be finished may be in them."""
    while left := {task for task in tasks if not task.done()}:
        for task in left:
            task.cancel()
        await asyncio.wait(left, timeout=AGAIN_S)


async def until_first_ends(*coroutines: Coroutine[Any, Any, Any]) -> None:
    """Run all until one ends, end the others, raise what one raised."""
    tasks = [asyncio.ensure_future(coroutine) for coroutine in coroutines]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        await end(*tasks)
    for task in tasks:
        if not task.cancelled() and (error := task.exception()):
            raise error
