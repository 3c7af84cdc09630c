"""Messages of a stream, read in batches from a sequence number on, without a consumer on the server.

The server's direct gets by batch (https://github.com/nats-io/nats-architecture-and-design, ADR-31), which nats-py
does not support. Each request is independent, so a restart of the server needs no new setup.
"""

import json
from collections.abc import AsyncIterator, Mapping
from datetime import UTC, datetime
from typing import NamedTuple

from nats.aio.client import Client
from nats.aio.subscription import Subscription
from nats.errors import TimeoutError as NatsTimeoutError

BATCH, BATCH_BYTES = 1000, 8 << 20
"""Maximum number and size of messages in one response, so that other users of the connection do not wait long."""
ANSWER_S = 10.0
"""Timeout of one message of a response [s]."""
_END, _NONE = "204", "404"


class Stored(NamedTuple):
    """A message of a stream."""

    subject: str
    sequence: int
    data: bytes
    headers: Mapping[str, str]


class StreamError(Exception):
    """Why a stream cannot be read now."""


async def read_stream(
    nc: Client, stream: str, subject: str, *, first: int = 1, since_s: float | None = None
) -> AsyncIterator[list[Stored]]:
    """Batches of messages, each in the order of the stream, up to the last there is.

    Args:
        nc: Connected.
        stream: Name of the stream; it must allow direct gets.
        subject: Subject of the messages; may have wildcards.
        first: Sequence number from which on.
        since_s: Wall clock from which stored messages are read, in place of ``first`` [s since 1970].

    Raises:
        StreamError: The server does not answer, or refuses.
    """
    start: dict[str, object] = {"seq": first}
    if since_s is not None:
        start = {"start_time": datetime.fromtimestamp(since_s, UTC).isoformat()}
    while True:
        batch, pending = await _batch(nc, stream, {"next_by_subj": subject, **start})
        if batch:
            yield batch
        if not pending:
            return
        start = {"seq": batch[-1].sequence + 1}


async def _batch(nc: Client, stream: str, request: dict[str, object]) -> tuple[list[Stored], bool]:
    """Messages, and whether there are more."""
    inbox = nc.new_inbox()
    answers = await nc.subscribe(inbox, pending_msgs_limit=-1, pending_bytes_limit=-1)
    try:
        wanted = json.dumps(request | {"batch": BATCH, "max_bytes": BATCH_BYTES}).encode()
        await nc.publish(f"$JS.API.DIRECT.GET.{stream}", wanted, reply=inbox)
        return await _answered(answers, stream)
    finally:
        await answers.unsubscribe()


async def _answered(answers: Subscription, stream: str) -> tuple[list[Stored], bool]:
    batch = list[Stored]()
    while True:
        try:
            message = await answers.next_msg(timeout=ANSWER_S)
        except NatsTimeoutError:
            raise StreamError(f"the server has not answered for {stream} within {ANSWER_S:g} s") from None
        headers = message.headers or {}
        status = headers.get("Status")
        if status is None:
            subject, sequence = headers["Nats-Subject"], int(headers["Nats-Sequence"])
            batch.append(Stored(subject, sequence, message.data, headers))
        elif status in (_END, _NONE):
            return batch, bool(batch) and int(headers.get("Nats-Num-Pending", 0)) > 0
        else:
            why = " ".join((headers.get("Description") or f"status {status}").split())
            hint = ": was `fleet serve` started, which makes its streams?" if status == "503" else ""
            raise StreamError(f"the server refuses to read {stream}: {why}{hint}")
