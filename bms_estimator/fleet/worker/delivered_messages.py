"""Delivered messages of one partition, which the block loop processes as long as the state includes all earlier messages.

All other messages need requests to the server. They are left to the task of the partition.
"""

import asyncio
import time
from collections.abc import Callable

from bms_estimator.fleet.worker.block_loop import BlockLoop
from bms_estimator.fleet.worker.pinned_consumer import DeliveredMessage, PinnedConsumer
from bms_estimator.fleet.worker.replay_guard import ReplayGuard
from bms_estimator.fleet.worker.result_publisher import ResultPublisher
from bms_estimator.fleet.worker.retry import Attempt

SILENCE_S = 3.0
"""Time without a delivery after which the stream is searched for further messages [s]. Another worker releases the partition in
less time."""


class DeliveredMessages:
    """Queue of one partition in the block loop.

    Args:
        consumer: Consumer of the partition.
        guard: Guard of the partition.
        results: Publisher of the results.
        block_loop: Loop of the worker.
        process: Processes a message that needs no request to the server.
        attempt: Runs an action and handles its errors.

    Attributes:
        pin: Number of the pin under which the claim was last confirmed.
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
        return delivered.follows and delivered.pin == self.pin and not self._guard.is_guarded(delivered.sequence)

    async def publish(self) -> None:
        """Publish the results of ``process_next``, and request further messages."""
        if self._results.added and not await self._attempt(self._publish):
            self.is_caught_up = False

    async def _publish(self) -> None:
        await self._results.publish_added()
        await self._consumer.request_taken()

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

    async def wait(self) -> None:
        """Let the block loop process messages until the task of the partition is woken up."""
        self._is_task_waiting = True
        if self._consumer.waiting:
            self._block_loop.add(self)
        try:
            await self._wake_up.wait()
        finally:
            self._is_task_waiting = False
