"""What must reach the broker, sent oldest first, several messages on their way at a time."""

import asyncio
from collections.abc import Iterable

from bms_estimator.sinks import Delivery
from bms_estimator.sinks.connection import Connection
from bms_estimator.sinks.messages import Message
from bms_estimator.sinks.refusals import name_refused
from bms_estimator.store.outbox import Outbox, Waiting

WINDOW = 16
"""Messages on their way to a broker that has not acknowledged them: below the 20 that brokers allow, so that the live
topics find room beside them."""


class Backlog:
    """Fills and empties an outbox.

    Args:
        outbox: The outbox.
        delivery: It is counted there what waits and what never arrives.
    """

    def __init__(self, outbox: Outbox, delivery: Delivery) -> None:
        self._outbox, self._delivery = outbox, delivery
        self._refused = 0
        self._moved = asyncio.Event()

    def put(self, messages: Iterable[Message]) -> None:
        """Keep messages until the broker has them; returns at once."""
        for message in messages:
            self._outbox.put(message)
        self._count()

    async def send(self, connection: Connection) -> None:
        """Send what is there and what comes, until the connection is lost.

        Raises:
            LinkError: It is, alone or in a group.
        """
        room = asyncio.Semaphore(WINDOW)

        async def carry(waiting: Waiting) -> None:
            await self._carry(connection, waiting)
            room.release()

        self._outbox.connected = True
        try:
            async with asyncio.TaskGroup() as on_their_way:
                while True:
                    for waiting in await self._outbox.take(WINDOW):
                        await room.acquire()
                        on_their_way.create_task(carry(waiting))  # tasks begin in the order in which they are made
        finally:
            self._outbox.connected = False
            self._outbox.rewind()

    async def emptied(self) -> None:
        """Wait until the broker has all of it."""
        while self._outbox.waiting:
            self._moved.clear()
            await self._moved.wait()

    async def _carry(self, connection: Connection, waiting: Waiting) -> None:
        """Send one message. What the broker refuses is counted and given up: else it would hold up all the rest."""
        topic = waiting.message.topic
        refusal = await connection.publish(waiting.message)
        if refusal is not None:
            self._refused += 1
            name_refused(self._delivery, topic, f"not allowed to write it: {refusal}")
        self._outbox.sent(waiting.number)
        self._count()
        self._moved.set()

    def _count(self) -> None:
        self._delivery.drops = self._outbox.dropped + self._refused
        self._delivery.waiting = self._outbox.waiting
