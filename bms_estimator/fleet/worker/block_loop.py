"""Loop that processes the delivered messages of all partitions of a worker in turn, and the queue of each partition.

The event loop runs between two slices of messages, not between two messages. Therefore the results of a slice are written to
the server together, and a message needs no task switch. The block loop processes the messages of a partition as long as its
state includes all earlier ones. All other messages need requests to the server, and are left to the task of the partition.
"""

import asyncio
import contextlib
import time
from collections.abc import Awaitable, Callable, Iterator

from bms_estimator.fleet.worker.block_result import ResultPublisher
from bms_estimator.fleet.worker.pinned_consumer import DeliveredMessage, PinnedConsumer
from bms_estimator.fleet.worker.takeover import ReplayGuard

SLICE_S = 0.004
"""Duration of a slice [s], after which the event loop sends heartbeats and receives messages. The last message of a slice may
exceed it."""


Attempt = Callable[[Callable[[], Awaitable[None]]], Awaitable[bool]]
"""Function that runs an action, logs an error of the connection or the server, and returns True if the action succeeded."""


class BlockLoop:
    """Loop of a worker, which serves the partitions in turn.

    Attributes:
        step_lock: Lock, held while a message is processed.
    """

    def __init__(self) -> None:
        self.step_lock = asyncio.Lock()
        self._ready: dict[DeliveredMessages, None] = {}  # in the order in which they are served
        self._wake_up = asyncio.Event()

    def add(self, queue: "DeliveredMessages") -> None:
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

    def _process_slice(self) -> set["DeliveredMessages"]:
        """Process messages for ``SLICE_S``. Return the served partitions."""
        end_s, served = time.monotonic() + SLICE_S, set[DeliveredMessages]()
        while self._ready and time.monotonic() < end_s:
            queue = next(iter(self._ready))
            del self._ready[queue]
            if queue.process_next():
                self._ready[queue] = None  # after the others
            served.add(queue)
        return served


SILENCE_S = 3.0
"""Time without a delivery after which the stream is searched for further messages [s]. It exceeds the time in which another
worker releases a partition."""


class DeliveredMessages:
    """Queue of the delivered messages of one partition, which the block loop and the task of the partition process.

    Args:
        consumer: Consumer of the partition.
        guard: Guard against blocks that kill workers.
        results: Publisher of the results.
        block_loop: Loop of the worker.
        process: Processes a message that needs no request to the server.
        attempt: Runs an action and handles its errors.

    Attributes:
        pin: Number of the pin (``DeliveredMessage.pin``) under which the claim was last confirmed.
        is_caught_up: True if the state includes all messages before the last delivered one.
        pin_lapsed: True if the ownership must be checked, because the pin has ended.
        next_search_s: Monotonic clock of the next search of the stream [s].
    """

    def __init__(
        self,
        consumer: PinnedConsumer,
        guard: ReplayGuard,
        results: ResultPublisher,
        block_loop: BlockLoop,
        process: Callable[[DeliveredMessage], None],
        attempt: Attempt,
    ) -> None:
        self._consumer, self._guard, self._results, self._block_loop = consumer, guard, results, block_loop
        self._process, self._attempt = process, attempt
        self.pin, self.is_caught_up, self.pin_lapsed = 0, False, False
        self.next_search_s = time.monotonic() + SILENCE_S
        self._is_task_waiting = False
        self._wake_up = asyncio.Event()

    def process_next(self) -> bool:
        """Process the next message, or wake up the task of the partition if the message needs a request to the server.

        Returns:
            True if the next call can process a message.
        """
        if not (self._is_task_waiting and self.can_process_next()):
            if self._consumer.waiting or self.pin_lapsed:
                self._wake_up.set()
            return False
        self.postpone_search()
        self._process(self._consumer.pop())
        return self.can_process_next()

    def can_process_next(self) -> bool:
        """Return True if a message waits, the state includes all earlier ones, and it needs no request to the server."""
        if not self._consumer.waiting or not self.is_caught_up or self.pin_lapsed:
            return False
        delivered = self._consumer.waiting[0]
        return (
            delivered.follows and delivered.pin == self.pin and not self._guard.is_guarded(delivered.message.sequence)
        )

    async def publish(self) -> None:
        """Publish the results of ``process_next``, and request further messages."""
        if self._results.added and not await self._attempt(self._publish):
            self.is_caught_up = False

    async def _publish(self) -> None:
        await self._results.publish_added()
        await self._consumer.refill()

    def postpone_search(self, silence_s: float = SILENCE_S) -> None:
        """Search the stream if no message has arrived for ``silence_s``."""
        self.next_search_s = time.monotonic() + silence_s

    def reset(self) -> None:
        """Leave all messages to the task of the partition until it has confirmed the claim."""
        self.pin, self.is_caught_up = 0, False

    def wake_up(self) -> None:
        """Wake up the task of the partition."""
        self._wake_up.set()

    def begin_pass(self) -> None:
        """Begin a pass of the task of the partition: later calls of ``wake_up`` cause another pass."""
        self._wake_up.clear()

    @contextlib.contextmanager
    def processed_by_loop(self) -> Iterator[None]:
        """Let the block loop process messages while the context lasts."""
        self._is_task_waiting = True
        if self._consumer.waiting:
            self._block_loop.add(self)
        try:
            yield
        finally:
            self._is_task_waiting = False

    async def wait(self) -> None:
        """Let the block loop process messages until the task of the partition is woken up."""
        with self.processed_by_loop():
            await self._wake_up.wait()
