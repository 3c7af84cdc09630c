"""Cancellation of tasks, and delays before retries."""

import asyncio
from contextlib import suppress

from bms_estimator.process.runtime import FIRST_DELAY_S, MAX_DELAY_S, Backoff, end_tasks, until_first_ends


def test_delays_double_up_to_the_maximum_and_differ_between_clients() -> None:
    for backoff, max_s in ((Backoff(), MAX_DELAY_S), (Backoff(max_s=120.0), 120.0)):
        for attempt in range(10):
            full_s = min(FIRST_DELAY_S * 2.0**attempt, max_s)
            assert full_s / 2.0 <= backoff.next_s() <= full_s
        backoff.reset()
        assert backoff.next_s() <= FIRST_DELAY_S
    assert len({Backoff().next_s() for _ in range(10)}) > 1


async def test_task_that_swallows_its_first_cancellation_ends_before_the_task_that_runs_it() -> None:
    started = asyncio.Event()

    async def swallow() -> None:
        started.set()
        with suppress(asyncio.CancelledError):
            await asyncio.Event().wait()
        await asyncio.Event().wait()

    running = asyncio.create_task(until_first_ends(swallow()))
    await started.wait()
    await end_tasks(running)
    assert running.cancelled()
    assert asyncio.all_tasks() == {asyncio.current_task()}
