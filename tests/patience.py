"""How long a test waits for what ought to come at once."""

import asyncio

LONG_S = 240.0
"""Only what hangs waits so long: a busy machine that compiles kernels on half a core takes minutes [s]."""


async def end(task: asyncio.Task[None]) -> None:
    """Cancel until it has ended: wait_for of Python 3.11, in what it calls, may swallow it once."""
    while not task.done():
        task.cancel()
        await asyncio.wait({task}, timeout=0.1)
