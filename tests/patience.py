"""Timeout of tests, and waiting for conditions."""

import asyncio
from collections.abc import Callable

LONG_S = 240.0
"""Timeout that only a hang reaches [s]. A busy machine may compile kernels for minutes."""


async def until(condition: Callable[[], object]) -> None:
    """Wait until ``condition`` returns something true."""
    async with asyncio.timeout(LONG_S):
        while not condition():  # noqa: ASYNC110 - files, counters and other processes have no event
            await asyncio.sleep(0.01)
