"""Reliable cancellation of tasks, and delays before retries.

Some libraries, and wait_for of Python 3.11, may swallow a cancellation.
"""

import asyncio
import contextlib
import random
from collections.abc import Coroutine
from typing import Any

FIRST_RETRY_S = 0.5
"""First retry delay of a missing or lost port; it doubles with each attempt [s]."""

MAX_RETRY_S = 10.0
"""Maximum retry delay of a missing or lost port [s]."""
FIRST_DELAY_S = 2.0
"""First delay of a ``Backoff``; it doubles with each attempt [s]."""
MAX_DELAY_S = 30.0
"""Maximum delay of a ``Backoff`` [s]. A local broker is usually unavailable for a short time only."""


class Backoff:
    """Increasing delays with jitter, so that not all clients of a broker reconnect at the same time.

    Args:
        first_s: First delay [s].
        max_s: Maximum delay [s].
    """

    def __init__(self, first_s: float = FIRST_DELAY_S, max_s: float = MAX_DELAY_S) -> None:
        self._first_s = self._next_s = first_s
        self._max_s = max_s

    def next_s(self) -> float:
        """Return the next delay [s]."""
        delay_s = self._next_s
        self._next_s = min(2.0 * delay_s, self._max_s)
        return delay_s * random.uniform(0.5, 1.0)

    def reset(self) -> None:
        """Restart with the first delay after a success."""
        self._next_s = self._first_s


CANCEL_INTERVAL_S = 0.1
"""Interval at which a task that ignores cancellation is cancelled again [s]."""


async def end(*tasks: asyncio.Future[Any]) -> None:
    """Cancel tasks repeatedly until all have ended. They must not contain work that has to be finished.

    A cancellation of the caller takes effect afterwards, because unfinished tasks would run on without an owner.
    """
    cancellation: asyncio.CancelledError | None = None
    while unfinished := {task for task in tasks if not task.done()}:
        for task in unfinished:
            task.cancel()
        try:
            await asyncio.wait(unfinished, timeout=CANCEL_INTERVAL_S)
        except asyncio.CancelledError as error:
            cancellation = error
    if cancellation:
        raise cancellation


async def finish(task: asyncio.Task[None], timeout_s: float) -> None:
    """Wait until a task has ended, and cancel it after ``timeout_s``. Raise its exception."""
    done, _ = await asyncio.wait([task], timeout=timeout_s)
    if not done:
        task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task


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
