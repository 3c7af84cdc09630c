"""Erasure of a stream's messages. A purge would leave their bytes in the server's files for an unlimited time."""

import asyncio
import json

from nats.aio.client import Client

from bms_estimator.fleet.nats.stream_reader import StreamError, read_stream

MAX_PENDING = 200
"""Maximum number of concurrent requests."""
RESPONSE_TIMEOUT_S = 10.0
"""Timeout of a request [s]."""
NOT_FOUND = 404
"""Error code of the server for a message that is already removed."""


async def erase_messages(nc: Client, stream: str, subject: str) -> int:
    """Remove the messages of a subject, and let the server overwrite their bytes in its files. Return their number.

    Args:
        nc: Connection to the tenant's NATS account.
        stream: Name of the stream; it must allow direct gets and deletes.
        subject: Subject of the messages; may have wildcards.

    Raises:
        StreamError: The server does not respond or rejects a request.
        nats.errors.Error: An error of the connection.
    """
    count = 0
    async for batch in read_stream(nc, stream, subject):
        sequences = [message.sequence for message in batch]
        for first in range(0, len(sequences), MAX_PENDING):
            await asyncio.gather(*(_erase(nc, stream, each) for each in sequences[first : first + MAX_PENDING]))
        count += len(sequences)
    return count


async def _erase(nc: Client, stream: str, sequence: int) -> None:
    """Remove one message. The server overwrites a message with random bytes unless the request has ``no_erase``."""
    request = json.dumps({"seq": sequence}).encode()
    response = await nc.request(f"$JS.API.STREAM.MSG.DELETE.{stream}", request, timeout=RESPONSE_TIMEOUT_S)
    error = json.loads(response.data).get("error")
    if error and error.get("code") != NOT_FOUND:
        raise StreamError(f"the server rejects removing a message of {stream}: {error.get('description', '')}")
