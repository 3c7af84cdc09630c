"""Reader of a stream's messages on a subject, between two sequence numbers."""

import asyncio
from collections.abc import AsyncGenerator

from nats.aio.client import Client

from bms_estimator.fleet.nats.stream_reader import RESPONSE_TIMEOUT_S, StoredMessage, StreamError, read_stream

POLL_S = 0.1
"""Poll interval while the responding node lags behind the stream's leader [s]."""


async def read_messages(
    nc: Client, stream: str, subject: str, first: int, last: int
) -> AsyncGenerator[StoredMessage, None]:
    """Yield all messages between two sequence numbers, in order.

    The node that responds may lag behind the stream's leader. Therefore it is polled until it has the message ``last``.

    Args:
        nc: Connection to the tenant's NATS account.
        stream: Name of the stream; it must allow direct gets.
        subject: Subject of the messages; may have wildcards.
        first: First stream sequence number.
        last: Stream sequence number of the subject's last message.

    Raises:
        StreamError: The server does not respond or rejects the request.
        nats.errors.Error: An error of the connection.
    """
    for _ in range(round(RESPONSE_TIMEOUT_S / POLL_S)):
        async for batch in read_stream(nc, stream, subject, first=first):
            for message in batch:
                if message.sequence <= last:
                    yield message
            first = batch[-1].sequence + 1
            if first > last:
                return
        if (await nc.jetstream().stream_info(stream)).state.first_seq > last:
            return  # the stream has dropped the messages meanwhile
        await asyncio.sleep(POLL_S)
    raise StreamError(f"the server has lost message {last} of {stream}, or the responding node lags far behind")
