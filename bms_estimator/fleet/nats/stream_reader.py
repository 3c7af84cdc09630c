"""Reader of a stream's messages in batches from a sequence number on, without a consumer on the server.

The reader uses batched direct gets (https://github.com/nats-io/nats-architecture-and-design, ADR-31), which nats-py does not
support. Each request is independent, so that reading continues after a restart of the server.
"""

import json
from collections.abc import AsyncGenerator, Mapping
from datetime import UTC, datetime
from typing import NamedTuple

from nats.aio.client import Client
from nats.aio.subscription import Subscription
from nats.errors import TimeoutError as NatsTimeoutError

BATCH_MESSAGES = 1000
"""Maximum number of messages in one response, so that other users of the connection do not wait long."""
BATCH_BYTES = 8 << 20
"""Maximum size of one response [bytes], so that other users of the connection do not wait long."""
RESPONSE_TIMEOUT_S = 10.0
"""Timeout of each message of a response [s]."""
_END_OF_BATCH, _NO_MESSAGES = "204", "404"  # values of the header Status


class StoredMessage(NamedTuple):
    """Message of a stream."""

    subject: str
    sequence: int
    data: bytes
    headers: Mapping[str, str]

    @property
    def received_s(self) -> int:
        """Server's clock at the arrival of the message, in whole seconds since 1970."""
        return int(datetime.fromisoformat(self.headers["Nats-Time-Stamp"]).replace(microsecond=0).timestamp())


class StreamError(Exception):
    """Error of a request to a stream, with its reason."""


async def read_stream(
    nc: Client, stream: str, subject: str, *, first: int = 1, since_s: float | None = None
) -> AsyncGenerator[list[StoredMessage], None]:
    """Yield batches of messages in the order of the stream, up to its last message.

    Args:
        nc: Connection to the tenant's NATS account.
        stream: Name of the stream; it must allow direct gets.
        subject: Subject of the messages; may have wildcards.
        first: First stream sequence number.
        since_s: Arrival time of the first message [s since 1970]; replaces ``first``.

    Raises:
        StreamError: The server does not respond or rejects the request.
    """
    start: dict[str, object] = {"seq": first}
    if since_s is not None:
        start = {"start_time": datetime.fromtimestamp(since_s, UTC).isoformat()}
    while True:
        batch, has_more = await _fetch_batch(nc, stream, {"next_by_subj": subject, **start})
        if batch:
            yield batch
        if not has_more:
            return
        start = {"seq": batch[-1].sequence + 1}


async def _fetch_batch(nc: Client, stream: str, request: dict[str, object]) -> tuple[list[StoredMessage], bool]:
    """Return one batch, and True if the stream has further messages."""
    inbox = nc.new_inbox()
    responses = await nc.subscribe(inbox, pending_msgs_limit=-1, pending_bytes_limit=-1)
    try:
        data = json.dumps(request | {"batch": BATCH_MESSAGES, "max_bytes": BATCH_BYTES}).encode()
        await nc.publish(f"$JS.API.DIRECT.GET.{stream}", data, reply=inbox)
        return await _collect(responses, stream)
    finally:
        await responses.unsubscribe()


async def _collect(responses: Subscription, stream: str) -> tuple[list[StoredMessage], bool]:
    """Receive the messages of one batch up to the status that ends it. Return the same values as ``_fetch_batch``."""
    batch = list[StoredMessage]()
    while True:
        try:
            message = await responses.next_msg(timeout=RESPONSE_TIMEOUT_S)
        except NatsTimeoutError:
            raise StreamError(f"the server has not responded for {stream} within {RESPONSE_TIMEOUT_S:g} s") from None
        headers = message.headers or {}
        status = headers.get("Status", "")
        if "Nats-Sequence" in headers:  # a stored message, whose sender may have set a status too
            subject, sequence = headers["Nats-Subject"], int(headers["Nats-Sequence"])
            batch.append(StoredMessage(subject, sequence, message.data, headers))
        elif status in (_END_OF_BATCH, _NO_MESSAGES):
            return batch, bool(batch) and int(headers.get("Nats-Num-Pending", 0)) > 0
        else:
            reason = " ".join((headers.get("Description") or f"status {status}").split())
            hint = ": was `fleet serve` started, which creates the streams?" if status == "503" else ""
            raise StreamError(f"the server rejects reading {stream}: {reason}{hint}")
