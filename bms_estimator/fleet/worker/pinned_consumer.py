"""Messages of one partition, from the durable consumer that the server pins to one worker at a time (ADR-42).

Measured with nats-server 2.15.1: a pin lasts ``streams.PIN_S`` from the last *request* that names it, with or without deliveries.
Therefore requests are renewed each ``RENEW_S`` and expire later than that, so that two or three are pending. A request without a
pin waits while another pin lasts. A request with an expired pin gets status 423.
"""

import json
from collections import deque
from typing import NamedTuple

from nats.aio.client import Client
from nats.aio.msg import Msg

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.stream_reader import StreamError
from bms_estimator.fleet.nats.streams import ANSWER_S, GROUP, PIN_S, consumer

RENEW_S = PIN_S / 4.0
"""Interval of requests [s]: the loop may be late by three of them without losing a pin."""
EXPIRES_S = 2.5 * RENEW_S
"""Expiry of a request [s]."""
BATCH = 32
"""Number of messages in a request, unless as many wait here."""
PIN_HEADER, STATUS_HEADER = "Nats-Pin-Id", "Status"
WRONG_PIN = "423"
QUIET = frozenset({"404", "408", "409"})
"""A request that has ended: without a message, in time, or since the consumer's leader changed. The next is on its way."""


class DeliveredMessage(NamedTuple):
    """A message of the stream."""

    pack: str
    data: bytes
    sequence: int
    """Sequence number in the stream."""
    pin: int
    """Number of times that this consumer has been pinned to this worker."""
    follows: bool
    """True if it follows the last delivered one directly: no other message of the partition lies between."""


class PinnedConsumer:
    """Requests messages of a partition and holds them until they are taken.

    Args:
        nc: Connected.
        partition: Number of the partition.
        inbox: Subject for the server's responses, to which it adds one token; its messages go to ``receive``.

    Attributes:
        waiting: Messages not taken yet.
        trouble: Why the last request failed; empty: it did not.
    """

    def __init__(self, nc: Client, partition: int, inbox: str) -> None:
        self._nc, self._inbox = nc, inbox
        self._next = f"$JS.API.CONSUMER.MSG.NEXT.{subjects.RAW_STREAM}.{consumer(partition)}"
        self._info = f"$JS.API.CONSUMER.INFO.{subjects.RAW_STREAM}.{consumer(partition)}"
        self._unpin = f"$JS.API.CONSUMER.UNPIN.{subjects.RAW_STREAM}.{consumer(partition)}"
        self.waiting: deque[DeliveredMessage] = deque()
        self.trouble = ""
        self._pin = ""
        self._pins = 0
        self._last = -1  # the consumer's own number of the last message
        self._taken = 0  # since the last request

    @property
    def pinned(self) -> bool:
        """True if this worker is pinned, by its own knowledge."""
        return bool(self._pin)

    async def is_pinned(self) -> bool:
        """Return True if the server has pinned it to any worker.

        Raises:
            StreamError: The consumer does not exist.
            nats.errors.Error: The server does not answer.
        """
        answer = json.loads((await self._nc.request(self._info, timeout=ANSWER_S)).data)
        if "error" in answer:
            raise StreamError(f"the server tells nothing of a partition: {answer['error'].get('description', '')}")
        return any(group.get("pinned_client_id") for group in answer.get("priority_groups") or ())

    async def renew(self) -> None:
        """Ask again; to be called each ``RENEW_S``. With enough waiting for one more only, which keeps the pin."""
        await self._ask(BATCH if len(self.waiting) < BATCH else 1)

    async def take(self) -> DeliveredMessage | None:
        """Return the next message; None without one."""
        if not self.waiting:
            return None
        self._taken += 1
        if self._taken >= BATCH // 2 and len(self.waiting) < BATCH:
            await self._ask(self._taken)
        return self.waiting.popleft()

    def receive(self, message: Msg) -> bool:
        """Take what the server sends. Whether this ended our pin."""
        headers = message.headers or {}
        status = headers.get(STATUS_HEADER)
        if status is None:
            self._add(message, headers.get(PIN_HEADER, ""))
            return False
        if status != WRONG_PIN:
            self.trouble = "" if status in QUIET else f"status {status} {headers.get('Description', '')}".strip()
            return False
        lost = self.pinned and message.subject.rpartition(".")[2] == str(self._pins)
        if lost:
            self._pin = ""
            self.waiting.clear()  # they are delivered again, here or elsewhere
        return lost

    async def unpin(self) -> None:
        """Release the partition to any worker that requests it."""
        pin, self._pin = self._pin, ""
        self.waiting.clear()
        if pin:
            await self._nc.request(self._unpin, json.dumps({"group": GROUP}).encode(), timeout=PIN_S)

    async def _ask(self, batch: int) -> None:
        request: dict[str, str | int] = {"batch": batch, "expires": round(1e9 * EXPIRES_S), "group": GROUP}
        if self._pin:
            request["id"] = self._pin
        self._taken = 0
        await self._nc.publish(self._next, json.dumps(request).encode(), f"{self._inbox}.{self._pins}")

    def _add(self, message: Msg, pin: str) -> None:
        stream_sequence, consumer_sequence = sequences(message.reply)
        if pin != self._pin:
            self._pin, self._pins = pin, self._pins + 1
        self.trouble = ""
        follows = consumer_sequence == self._last + 1
        self._last = consumer_sequence
        pack = message.subject.rpartition(".")[2]
        self.waiting.append(DeliveredMessage(pack, message.data, stream_sequence, self._pins, follows))


def sequences(reply: str) -> tuple[int, int]:
    """Return a message's sequence number in its stream, and its gapless one in the consumer.

    Args:
        reply: Acknowledgment subject (ADR-15): 9 tokens, or 11 and more with the server's domain.
    """
    tokens = reply.split(".")
    first = 5 if len(tokens) == 9 else 7
    return int(tokens[first]), int(tokens[first + 1])
