"""Snapshot of a stream, and restoration of a stream from a snapshot.

nats-py does not support these requests of the server (https://docs.nats.io/reference/jetstream/api/stream/restore). A snapshot
contains the messages that are stored when it begins, with their sequence numbers, and the consumers with their positions. It does
not contain a message that is removed while the snapshot is sent.
"""

import json
from collections.abc import Callable, Iterable
from typing import Any

from nats.aio.client import Client
from nats.errors import NoRespondersError, TimeoutError as NatsTimeoutError
from pydantic import BaseModel, ConfigDict

from bms_estimator.fleet.nats.stream_reader import StreamError

RESPONSE_TIMEOUT_S = 30.0
"""Timeout of the response to a request or to a chunk [s]."""
RESTORE_TIMEOUT_S = 3600.0
"""Timeout of the response to the last chunk [s]. The server writes all messages before it responds."""
COMPLETE = "204"
"""Status of the message after the last chunk of a complete snapshot; earlier versions of the server send none."""


class StreamInfo(BaseModel):
    """Configuration and state of a stream, as the server describes them."""

    model_config = ConfigDict(frozen=True)

    config: dict[str, Any]
    state: dict[str, Any]


async def read_info(nc: Client, stream: str) -> StreamInfo:
    """Return configuration and state of a stream.

    Raises:
        StreamError: The server does not respond, or has no such stream.
    """
    return StreamInfo.model_validate(await _request(nc, f"$JS.API.STREAM.INFO.{stream}", {}, stream))


async def read_snapshot(nc: Client, stream: str, write: Callable[[bytes], object]) -> StreamInfo:
    """Read a snapshot of a stream.

    Args:
        nc: Connection to the tenant's NATS account.
        stream: Name of the stream.
        write: Receives the chunks of the snapshot.

    Raises:
        StreamError: The server does not respond, has no such stream, or aborts the snapshot.
    """
    inbox = nc.new_inbox()
    chunks = await nc.subscribe(inbox, pending_msgs_limit=-1, pending_bytes_limit=-1)
    try:
        request = {"deliver_subject": inbox}
        info = StreamInfo.model_validate(await _request(nc, f"$JS.API.STREAM.SNAPSHOT.{stream}", request, stream))
        while True:
            chunk = await chunks.next_msg(timeout=RESPONSE_TIMEOUT_S)
            if not chunk.data:
                break
            write(chunk.data)
            if chunk.reply:
                await nc.publish(chunk.reply)  # lets the server send further chunks
    except NatsTimeoutError:
        raise StreamError(f"{stream}: the server has not responded for {RESPONSE_TIMEOUT_S:g} s") from None
    finally:
        await chunks.unsubscribe()
    headers = chunk.headers or {}
    if headers.get("Status", COMPLETE) != COMPLETE:
        raise StreamError(f"{stream}: the server aborts the snapshot: {headers.get('Description', headers['Status'])}")
    return info


async def restore_stream(nc: Client, info: StreamInfo, chunks: Iterable[bytes]) -> None:
    """Create a stream from a snapshot.

    Args:
        nc: Connection to the tenant's NATS account.
        info: Configuration of the new stream, and state of the stream at its snapshot.
        chunks: Bytes of the snapshot.

    Raises:
        StreamError: The stream exists already, the snapshot is damaged, or the server does not respond.
    """
    stream = info.config["name"]
    try:
        response = await _request(nc, f"$JS.API.STREAM.RESTORE.{stream}", info.model_dump(), stream)
        subject = response["deliver_subject"]
        for chunk in chunks:
            reply = await nc.request(subject, chunk, timeout=RESPONSE_TIMEOUT_S)
            if reply.data:
                raise StreamError(f"{stream}: the server rejects the snapshot: {reply.data.decode(errors='replace')}")
        _raise_error(stream, json.loads((await nc.request(subject, b"", timeout=RESTORE_TIMEOUT_S)).data))
    except NatsTimeoutError:
        raise StreamError(f"{stream}: the server does not respond to the restoration") from None


async def _request(nc: Client, subject: str, request: dict[str, Any], stream: str) -> dict[str, Any]:
    """Send a request, and return the server's response.

    Raises:
        StreamError: The server does not respond, or rejects the request.
    """
    try:
        response = await nc.request(subject, json.dumps(request).encode(), timeout=RESPONSE_TIMEOUT_S)
    except NoRespondersError:
        raise StreamError(f"{stream}: the server has no streams for this account") from None
    except NatsTimeoutError:
        raise StreamError(f"{stream}: the server has not responded for {RESPONSE_TIMEOUT_S:g} s") from None
    return _raise_error(stream, json.loads(response.data))


def _raise_error(stream: str, response: dict[str, Any]) -> dict[str, Any]:
    if "error" in response:
        raise StreamError(f"{stream}: the server rejects the request: {response['error'].get('description', '')}")
    return response
