"""Timeout of tests."""

import asyncio

LONG_S = 240.0
"""Timeout that only a hang reaches [s]. A busy machine may compile kernels for minutes."""


async def end(task: asyncio.Task[None]) -> None:
    """Cancel a task until it has ended, because wait_for of Python 3.11 may swallow one cancellation."""
    while not task.done():
        task.cancel()
        await asyncio.wait({task}, timeout=0.1)
