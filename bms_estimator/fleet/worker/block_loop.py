"""Loop that processes the delivered blocks of all partitions of a worker, in the order of their arrival.

The event loop runs between two slices of blocks, not between two blocks. The messages of a slice are therefore written to the
server at once, and a block needs no switch of tasks.
"""

import asyncio
import time
from collections import deque
from typing import Protocol

SLICE_S = 0.004
"""Time after which the event loop can send heartbeats and receive messages [s]. A slice ends with the block that exceeds it."""


class BlockQueue(Protocol):
    """Queue of the delivered messages of one partition (``PartitionLease``)."""

    def process_next(self) -> None:
        """Process the next message, or leave it to the task of the partition."""

    async def publish(self) -> None:
        """Publish the results of the processed messages."""


class BlockLoop:
    """Loop of a worker.

    Attributes:
        step_lock: Lock, held while a block is processed.
    """

    def __init__(self) -> None:
        self.step_lock = asyncio.Lock()
        self._ready: deque[BlockQueue] = deque()
        self._wake_up = asyncio.Event()

    def add(self, queue: BlockQueue) -> None:
        """Process the next message of a partition in its turn."""
        self._ready.append(queue)
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

    def _process_slice(self) -> list[BlockQueue]:
        """Process messages for ``SLICE_S``. Return the partitions that were served."""
        end_s = time.monotonic() + SLICE_S
        served: dict[BlockQueue, None] = {}
        while self._ready and time.monotonic() < end_s:
            queue = self._ready.popleft()
            queue.process_next()
            served[queue] = None
        return list(served)
