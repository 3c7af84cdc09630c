"""Erasure of a stream's messages. A purge would leave their bytes in the server's files for an unlimited time."""

import asyncio
import contextlib

from nats.aio.client import Client
from nats.js import JetStreamContext
from nats.js.errors import NotFoundError

from bms_estimator.fleet.nats.stream_reader import read_stream

MAX_PENDING = 200
"""Maximum number of concurrent requests."""


async def erase_messages(nc: Client, stream: str, subject: str) -> int:
    """Remove the messages of a subject, and let the server overwrite their bytes in its files. Return their number.

    Args:
        nc: Connection to the tenant's NATS account.
        stream: Name of the stream; it must allow direct gets and deletes.
        subject: Subject of the messages; may have wildcards.

    Raises:
        StreamError: The server does not respond, or rejects reading the stream.
        nats.errors.Error: An error of the connection, or the server rejects a request.
    """
    js, count = nc.jetstream(), 0
    async for batch in read_stream(nc, stream, subject):
        sequences = [message.sequence for message in batch]
        for first in range(0, len(sequences), MAX_PENDING):
            await asyncio.gather(*(_erase(js, stream, each) for each in sequences[first : first + MAX_PENDING]))
        count += len(sequences)
    return count


async def _erase(js: JetStreamContext, stream: str, sequence: int) -> None:
    """Remove one message. The server overwrites its bytes, because the request does not have ``no_erase``."""
    with contextlib.suppress(NotFoundError):  # removed meanwhile
        await js.delete_msg(stream, sequence)
