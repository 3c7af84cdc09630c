"""Loop that processes the delivered messages of all partitions of a worker in turn.

The event loop runs between two slices of messages, not between two messages. Therefore the results of a slice are written to
the server together, and a message needs no switch of tasks.
"""

import asyncio
import time
from typing import Protocol

SLICE_S = 0.004
"""Duration of a slice [s], after which the event loop sends heartbeats and receives messages. The last message of a slice may
exceed it."""


class BlockQueue(Protocol):
    """Delivered messages of one partition (``DeliveredMessages``)."""

    def process_next(self) -> bool:
        """Process the next message, or leave it to the task of the partition. Return True if the next call can process one."""

    async def publish(self) -> None:
        """Publish the results of the processed messages."""


class BlockLoop:
    """Loop of a worker, which serves the partitions in turn.

    Attributes:
        step_lock: Lock, held while a message is processed.
    """

    def __init__(self) -> None:
        self.step_lock = asyncio.Lock()
        self._ready: dict[BlockQueue, None] = {}  # in the order in which they are served
        self._wake_up = asyncio.Event()

    def add(self, queue: BlockQueue) -> None:
        """Process the messages of a partition in its turn."""
        self._ready.setdefault(queue)
        self._wake_up.set()

    async def run(self) -> None:
        """Process messages until cancelled."""
        while True:
            if not self._ready:
                self._wake_up.clear()
                await self._wake_up.wait()
            async with self.step_lock:
                served = self._process_slice()
            for queue in served:
                await queue.publish()
            await asyncio.sleep(0)

    def _process_slice(self) -> set[BlockQueue]:
        """Process messages for ``SLICE_S``. Return the served partitions."""
        end_s, served = time.monotonic() + SLICE_S, set[BlockQueue]()
        while self._ready and time.monotonic() < end_s:
            queue = next(iter(self._ready))
            del self._ready[queue]
            if queue.process_next():
                self._ready[queue] = None  # at the end
            served.add(queue)
        return served
