"""Sender of queued messages, the oldest first, several in flight; and the topics that the broker denies."""

import asyncio
from collections.abc import Callable, Sequence
from typing import Protocol

import structlog

from bms_estimator.mqtt.connection import Connection, DeliveryStats, Message, PublishRejection, QueuedMessage
from bms_estimator.process.runtime import Backoff

log = structlog.get_logger(__name__)


class DeniedTopics:
    """Reports denied topics in log and health. After a temporary rejection, it requests a resend of retained messages.

    Args:
        delivery: Statistics that list the denied topics.
        resend_retained: Function that sends all retained messages again.
        first_delay_s: Delay after the first temporary rejection [s]. The delay doubles with each rejection.
    """

    def __init__(self, delivery: DeliveryStats, resend_retained: Callable[[], object], first_delay_s: float) -> None:
        self._delivery, self._resend_retained, self._backoff = delivery, resend_retained, Backoff(first_delay_s)
        self._logged: set[str] = set()  # each topic is logged once per connection
        self._denied: dict[str, None] = {}  # dicts instead of sets: they keep the order of the rejections
        self._temporarily_denied: dict[str, None] = {}
        self._resend_timer: asyncio.TimerHandle | None = None

    def on_connected(self) -> None:
        """Clear the denied topics at the beginning of a connection."""
        self.on_disconnected()
        for topics in (self._logged, self._denied, self._temporarily_denied):
            topics.clear()
        self._update_stats()
        self._backoff.reset()

    def on_disconnected(self) -> None:
        """Cancel a pending resend at the end of a connection."""
        if self._resend_timer is not None:
            self._resend_timer.cancel()
            self._resend_timer = None

    def deny(self, topic: str, reason: str) -> None:
        """Record that a topic is denied."""
        self._denied[topic] = None
        self._report("broker refuses a topic; see its access list", topic, reason)

    def allow(self, topic: str) -> None:
        """Record that a topic is allowed."""
        self._denied.pop(topic, None)
        self._update_stats()

    def record_result(self, message: Message, rejection: PublishRejection | None) -> None:
        """Record that the broker accepted or rejected a message."""
        if rejection is not None and rejection.is_retryable:
            self._temporarily_denied[message.topic] = None
            self._report("broker temporarily refuses a topic; retrying", message.topic, rejection.reason)
            if message.retain and self._resend_timer is None:
                delay_s = self._backoff.next_s()
                self._resend_timer = asyncio.get_running_loop().call_later(delay_s, self._resend)
            return
        # a denied topic stays denied after an accepted message, because the denial may concern reading
        if message.topic in self._temporarily_denied:
            del self._temporarily_denied[message.topic]
            self._update_stats()
            if not self._temporarily_denied:
                self._backoff.reset()
        if rejection is not None:
            self.deny(message.topic, f"not allowed to write it: {rejection.reason}")

    def _resend(self) -> None:
        self._resend_timer = None
        self._resend_retained()

    def _report(self, event: str, topic: str, reason: str) -> None:
        """Update the statistics, and log each topic once."""
        self._update_stats()
        if topic not in self._logged:
            self._logged.add(topic)
            log.warning(event, topic=topic, reason=reason)

    def _update_stats(self) -> None:
        self._delivery.refused_topics = list(self._denied | self._temporarily_denied)


WINDOW = 16
"""Maximum number of unacknowledged queued messages. Brokers and paho allow 20 in flight; four remain for live topics."""


class MessageQueue(Protocol):
    """Queue of numbered messages, such as ``Outbox``.

    Attributes:
        connected: True if a broker is connected, as set by the sender.
    """

    connected: bool

    @property
    def waiting(self) -> int:
        """Number of messages that the broker has not acknowledged."""

    @property
    def dropped(self) -> int:
        """Number of messages dropped since start because the queue was full."""

    async def take(self, max_count: int) -> Sequence[QueuedMessage]:
        """Wait for a message, then return up to ``max_count`` of the oldest that were not returned since ``rewind``."""

    def acknowledge(self, number: int, rejection: str = "") -> None:
        """Record that the broker has acknowledged a message, or the reason why it has permanently rejected the message."""

    def rewind(self) -> None:
        """Make ``take`` return all unacknowledged messages again, in order, after a lost connection."""


class QueueSender:
    """Sends the messages of a queue in order.

    Args:
        outbox: Queue to empty.
        delivery: Statistics in which waiting and dropped messages are counted.
        denied: Denied topics, updated from the broker's results.
        first_delay_s: Delay before a temporarily rejected message is retried [s]. The delay doubles with each retry.
    """

    def __init__(
        self, outbox: MessageQueue, delivery: DeliveryStats, denied: DeniedTopics, first_delay_s: float
    ) -> None:
        self._outbox, self._delivery, self._denied = outbox, delivery, denied
        self._backoff = Backoff(first_delay_s)
        self._rejected = 0
        self._acknowledged = asyncio.Event()

    async def send(self, connection: Connection) -> None:
        """Send queued and new messages until the connection is lost.

        Raises:
            BrokerConnectionError: The connection is lost; may be raised inside an exception group.
        """
        self._outbox.connected = True
        self._backoff.reset()
        try:
            while True:
                await self._stream(connection)
                await self._try_oldest(connection)
        finally:
            self._outbox.connected = False
            self._outbox.rewind()

    async def wait_until_empty(self) -> None:
        """Wait until the broker has acknowledged all messages."""
        while self._outbox.waiting:
            self._acknowledged.clear()
            await self._acknowledged.wait()

    async def _stream(self, connection: Connection) -> None:
        """Send until the broker rejects a message temporarily. On return, no message is in flight."""
        window = asyncio.Semaphore(WINDOW)

        async def send(queued: QueuedMessage) -> None:
            if not await self._send_one(connection, queued):
                feeding.cancel()
            window.release()

        async def feed() -> None:
            while True:
                for queued in await self._outbox.take(WINDOW):
                    await window.acquire()
                    in_flight.create_task(send(queued))  # tasks start in the order of their creation

        async with asyncio.TaskGroup() as in_flight:
            feeding = in_flight.create_task(feed())
        self._outbox.rewind()

    async def _try_oldest(self, connection: Connection) -> None:
        """Retry the oldest message alone, so that no message overtakes it, until it is accepted or finally rejected."""
        while True:
            await asyncio.sleep(self._backoff.next_s())
            for oldest in await self._outbox.take(1):
                if await self._send_one(connection, oldest):
                    self._backoff.reset()
                    return
            self._outbox.rewind()

    async def _send_one(self, connection: Connection, queued: QueuedMessage) -> bool:
        """Send one message. Return False if the message must be retried.

        A permanently rejected message is counted and dropped, because it would block all others.
        """
        rejection = await connection.publish(queued.message)
        self._denied.record_result(queued.message, rejection)
        if rejection is not None and rejection.is_retryable:
            return False
        self._rejected += rejection is not None
        self._outbox.acknowledge(queued.number, rejection.reason if rejection else "")
        self.update_stats()
        self._acknowledged.set()
        return True

    def update_stats(self) -> None:
        """Update the numbers of dropped and waiting messages."""
        self._delivery.drops = self._outbox.dropped + self._rejected
        self._delivery.waiting = self._outbox.waiting
