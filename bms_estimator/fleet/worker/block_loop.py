"""Loop that processes the delivered blocks of all partitions of a worker, in the order of their arrival.

The event loop runs between two slices of blocks, not between two blocks. The messages of a slice are therefore written to the
server at once, and a block needs no switch of tasks.
"""

import asyncio
import time
from typing import Protocol

SLICE_S = 0.004
"""Time after which the event loop can send heartbeats and receive messages [s]. A slice ends with the block that exceeds it."""


class BlockQueue(Protocol):
    """Queue of the delivered messages of one partition (``PartitionLease``)."""

    def process_next(self) -> bool:
        """Process the next message, or leave it to the task of the partition. Return True if the next call can process one."""

    async def publish(self) -> None:
        """Publish the results of the processed messages."""


class BlockLoop:
    """Loop of a worker, which serves the partitions in turn.

    Attributes:
        step_lock: Lock, held while a block is processed.
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
