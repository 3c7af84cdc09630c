"""Consumer of one partition: a durable consumer that the server pins to one worker at a time.

The protocol is ADR-42 of https://github.com/nats-io/nats-architecture-and-design. Measured with nats-server 2.15.1: a pin
lasts ``streams.PIN_S`` from the last *request* that names it, with or without deliveries. Therefore a request is sent each
``RENEW_S``. A request expires only after the next one is sent, so that two or three requests are pending. A request
without a pin waits while another pin lasts. A request with an expired pin gets status 423.
"""

import json
from collections import deque
from typing import NamedTuple

from nats.aio.client import Client
from nats.aio.msg import Msg

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.stream_reader import StreamError
from bms_estimator.fleet.nats.streams import PIN_S, PRIORITY_GROUP, RESPONSE_TIMEOUT_S, consumer
from bms_estimator.fleet.worker.partition_reader import RawMessage, raw_message

RENEW_S = PIN_S / 4.0
"""Interval of requests [s]. A pin survives if the event loop is late by three intervals."""
EXPIRES_S = 2.5 * RENEW_S
"""Expiry of a request [s]."""
BATCH = 32
"""Number of messages in a request. If this many messages wait, a request is for one message only, to renew the pin."""
PIN_HEADER = "Nats-Pin-Id"
"""Header with the identifier of the pin under which a message is delivered."""
STATUS_HEADER = "Status"
"""Header of a response without a message."""
WRONG_PIN = "423"
"""Status of a request with an expired pin."""


class DeliveredMessage(NamedTuple):
    """Message of the partition, delivered to this worker."""

    message: RawMessage
    pin: int
    """Number of the pin under which this worker received the message, from 1."""
    follows: bool
    """True if no other message of the partition lies between this one and the last delivered one."""


class PinnedConsumer:
    """Consumer that requests messages of a partition, and queues them until they are processed.

    Args:
        nc: Connection to the tenant's NATS account.
        partition: Number of the partition.
        inbox: Prefix of the subject for responses; one token is added. The caller passes its messages to ``receive``.

    Attributes:
        waiting: Queued messages.
    """

    def __init__(self, nc: Client, partition: int, inbox: str) -> None:
        self._nc, self._inbox = nc, inbox
        self._next_subject = f"$JS.API.CONSUMER.MSG.NEXT.{subjects.RAW_STREAM}.{consumer(partition)}"
        self._info_subject = f"$JS.API.CONSUMER.INFO.{subjects.RAW_STREAM}.{consumer(partition)}"
        self._unpin_subject = f"$JS.API.CONSUMER.UNPIN.{subjects.RAW_STREAM}.{consumer(partition)}"
        self.waiting: deque[DeliveredMessage] = deque()
        self._pin, self._pin_count = "", 0
        self._last_consumer_sequence = -1  # of the last message; initially a value that no message follows
        self._popped_since_request = 0  # number of messages

    @property
    def has_pin(self) -> bool:
        """True if the consumer is pinned to this worker as far as it knows."""
        return bool(self._pin)

    async def is_pinned_to_any_worker(self) -> bool:
        """Return True if the server has pinned the consumer to any worker.

        Raises:
            StreamError: The consumer does not exist.
            nats.errors.Error: The server does not respond.
        """
        response = json.loads((await self._nc.request(self._info_subject, timeout=RESPONSE_TIMEOUT_S)).data)
        if "error" in response:
            raise StreamError(
                f"the server does not describe the consumer of a partition: {response['error'].get('description', '')}"
            )
        return any(group.get("pinned_client_id") for group in response.get("priority_groups") or ())

    async def renew(self) -> None:
        """Send a request, which renews the pin. If ``BATCH`` messages wait, only one message is requested.

        The caller calls this method each ``RENEW_S``.
        """
        await self._request(BATCH if len(self.waiting) < BATCH else 1)

    def pop(self) -> DeliveredMessage:
        """Return the next queued message. The caller has checked that ``waiting`` is not empty."""
        self._popped_since_request += 1
        return self.waiting.popleft()

    async def refill(self) -> None:
        """After half a batch of messages was popped, request as many new ones."""
        if self._popped_since_request >= BATCH // 2 and len(self.waiting) < BATCH:
            await self._request(self._popped_since_request)

    def receive(self, message: Msg) -> bool:
        """Process a message or status from the server. Return True if the status ends this worker's pin."""
        headers = message.headers or {}
        status = headers.get(STATUS_HEADER)
        if status is None:
            self._queue_message(message, headers.get(PIN_HEADER, ""))
            return False
        # after any other status the next request follows; a status may still answer a request under an earlier pin
        is_of_present_pin = self.has_pin and message.subject.rpartition(".")[2] == str(self._pin_count)
        is_pin_lost = status == WRONG_PIN and is_of_present_pin
        if is_pin_lost:
            self._pin = ""
            self.waiting.clear()  # the server delivers them again to the next pinned worker
        return is_pin_lost

    async def unpin(self) -> None:
        """Release the pin, so that another worker can get it at once."""
        pin, self._pin = self._pin, ""
        self.waiting.clear()
        if pin:
            await self._nc.request(self._unpin_subject, json.dumps({"group": PRIORITY_GROUP}).encode(), timeout=PIN_S)

    async def _request(self, batch: int) -> None:
        request: dict[str, str | int] = {"batch": batch, "expires": round(1e9 * EXPIRES_S), "group": PRIORITY_GROUP}
        if self._pin:
            request["id"] = self._pin
        self._popped_since_request = 0
        await self._nc.publish(self._next_subject, json.dumps(request).encode(), f"{self._inbox}.{self._pin_count}")

    def _queue_message(self, message: Msg, pin: str) -> None:
        position = parse_position(message.reply)
        if pin != self._pin:
            self._pin, self._pin_count = pin, self._pin_count + 1
        follows = position.consumer_sequence == self._last_consumer_sequence + 1
        self._last_consumer_sequence = position.consumer_sequence
        raw = raw_message(message.subject, message.data, position.stream_sequence, position.received_s)
        self.waiting.append(DeliveredMessage(raw, self._pin_count, follows))


class MessagePosition(NamedTuple):
    """Position of a delivered message."""

    stream_sequence: int
    """Sequence number in the stream."""
    consumer_sequence: int
    """Sequence number in the consumer, without gaps."""
    received_s: int
    """Server's clock at the arrival of the message [s since 1970]."""


def parse_position(reply: str) -> MessagePosition:
    """Return the position of a delivered message.

    Args:
        reply: Acknowledgment subject (ADR-15 of NATS): 9 tokens, or at least 11 with the server's domain.
    """
    tokens = reply.split(".")
    first = 5 if len(tokens) == 9 else 7
    stream_sequence, consumer_sequence, received_ns = (int(token) for token in tokens[first : first + 3])
    return MessagePosition(stream_sequence, consumer_sequence, received_ns // 10**9)
