"""Sender of messages that must reach the broker: oldest first, several in flight."""

import asyncio
from collections.abc import Sequence
from typing import Protocol

from bms_estimator.mqtt.connection import Connection
from bms_estimator.mqtt.delivery_stats import DeliveryStats
from bms_estimator.mqtt.denied_topics import DeniedTopics
from bms_estimator.mqtt.message import QueuedMessage
from bms_estimator.process.backoff import Backoff

WINDOW = 16
"""Maximum number of unacknowledged messages: below the 20 that brokers allow, so that live topics have room."""


class MessageQueue(Protocol):
    """Messages in order, each with a number, as ``Outbox`` keeps them.

    Attributes:
        connected: True if a broker is connected, as set by the sender.
    """

    connected: bool

    @property
    def waiting(self) -> int:
        """Messages that the broker has not acknowledged."""

    @property
    def dropped(self) -> int:
        """Messages that found no room, since start."""

    async def take(self, most: int) -> Sequence[QueuedMessage]:
        """Wait until there is a message, and hand out up to ``most`` of the oldest that were not since ``rewind``."""

    def sent(self, number: int) -> None:
        """Record that the broker has acknowledged a message."""

    def rewind(self) -> None:
        """Hand out again, in order, all messages that were not acknowledged, after a connection was lost."""


class QueueSender:
    """Empties what keeps messages in order.

    Args:
        outbox: What keeps them.
        delivery: It is counted there what waits and what never arrives.
        refusals: Receives the broker's results.
        first_delay_s: Delay before a temporarily rejected message is retried; doubles with each time [s].
    """

    def __init__(
        self, outbox: MessageQueue, delivery: DeliveryStats, refusals: DeniedTopics, first_delay_s: float
    ) -> None:
        self._outbox, self._delivery, self._refusals = outbox, delivery, refusals
        self._pauses = Backoff(first_delay_s)
        self._refused = 0
        self._moved = asyncio.Event()

    async def send(self, connection: Connection) -> None:
        """Send queued and new messages until the connection is lost.

        Raises:
            BrokerConnectionError: It is, alone or in a group.
        """
        self._outbox.connected = True
        self._pauses.reset()
        try:
            while True:
                await self._stream(connection)
                await self._try_oldest(connection)
        finally:
            self._outbox.connected = False
            self._outbox.rewind()

    async def wait_until_empty(self) -> None:
        """Wait until the broker has all of it."""
        while self._outbox.waiting:
            self._moved.clear()
            await self._moved.wait()

    async def _stream(self, connection: Connection) -> None:
        """Send until the broker refuses one for now; then none is on its way any more, nor handed out."""
        room = asyncio.Semaphore(WINDOW)

        async def carry(waiting: QueuedMessage) -> None:
            if not await self._send_one(connection, waiting):
                feeding.cancel()
            room.release()

        async def feed() -> None:
            while True:
                for waiting in await self._outbox.take(WINDOW):
                    await room.acquire()
                    on_their_way.create_task(carry(waiting))  # tasks begin in the order in which they are made

        async with asyncio.TaskGroup() as on_their_way:
            feeding = on_their_way.create_task(feed())
        self._outbox.rewind()

    async def _try_oldest(self, connection: Connection) -> None:
        """Retry the oldest message alone, so that none overtakes it, until the broker accepts or drops one."""
        while True:
            await asyncio.sleep(self._pauses.next_s())
            for oldest in await self._outbox.take(1):
                if await self._send_one(connection, oldest):
                    self._pauses.reset()
                    return
            self._outbox.rewind()

    async def _send_one(self, connection: Connection, waiting: QueuedMessage) -> bool:
        """Send one message; False: to be tried again.

        A permanently rejected message is counted and dropped, because it would block all others.
        """
        refusal = await connection.publish(waiting.message)
        self._refusals.record_result(waiting.message, refusal)
        if refusal is not None and refusal.is_retryable:
            return False
        self._refused += refusal is not None
        self._outbox.sent(waiting.number)
        self._count()
        self._moved.set()
        return True

    def _count(self) -> None:
        self._delivery.drops = self._outbox.dropped + self._refused
        self._delivery.waiting = self._outbox.waiting
