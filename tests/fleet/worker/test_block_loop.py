"""The block loop serves the partitions in turn, and lets the event loop run between two slices."""

import asyncio

from bms_estimator.fleet.worker.block_loop import BlockLoop
from bms_estimator.process.runtime import end_tasks


class Messages:
    """Messages of one partition: ``number`` of them, or an endless sequence."""

    def __init__(self, order: list["Messages"], number: int | None = None) -> None:
        self._order, self._number = order, number
        self.processed = 0
        self.published: asyncio.Queue[int] = asyncio.Queue()

    def process_next(self) -> bool:
        self._order.append(self)
        self.processed += 1
        return self.processed != self._number

    async def publish(self) -> None:
        await self.published.put(self.processed)


async def test_other_tasks_run_while_messages_wait() -> None:
    messages, loop = Messages([]), BlockLoop()
    loop.add(messages)
    running = asyncio.create_task(loop.run())
    for _ in range(5):
        await messages.published.get()  # returns only if the loop does not occupy the event loop
    await end_tasks(running)


async def test_partitions_are_served_in_turn() -> None:
    order: list[Messages] = []
    endless, few, loop = Messages(order), Messages(order, 3), BlockLoop()
    loop.add(endless)
    loop.add(few)
    running = asyncio.create_task(loop.run())
    while await few.published.get() < 3:
        pass
    assert order[:6] == [endless, few] * 3
    await end_tasks(running)


async def test_no_message_is_processed_while_the_lock_is_held() -> None:
    messages, loop = Messages([], 1), BlockLoop()
    loop.add(messages)
    async with loop.step_lock:
        running = asyncio.create_task(loop.run())
        for _ in range(10):
            await asyncio.sleep(0)
        assert messages.processed == 0
    assert await messages.published.get() == 1
    await end_tasks(running)
