"""Waiting time of tests."""

import asyncio

LONG_S = 240.0
"""Limit that only a hang reaches: a busy machine that compiles kernels on half a core takes minutes [s]."""


async def end(task: asyncio.Task[None]) -> None:
    """Cancel until it has ended: wait_for of Python 3.11 may swallow a cancellation once."""
    while not task.done():
        task.cancel()
        await asyncio.wait({task}, timeout=0.1)
