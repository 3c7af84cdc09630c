"""Messages of a stream on a subject, between two sequence numbers."""

import asyncio
from collections.abc import AsyncGenerator

from nats.aio.client import Client

from bms_estimator.fleet.nats.stream_reader import ANSWER_S, Stored, StreamError, read_stream

BEHIND_S = 0.1
"""Poll interval while a node lacks data that another one has [s]."""


async def stored(nc: Client, stream: str, subject: str, first: int, last: int) -> AsyncGenerator[Stored, None]:
    """All messages from one sequence to another, in their order.

    The node that responds may lag behind the stream's leader, so they end with the message ``last``, not where that
    node has no more.

    Args:
        nc: Connected.
        stream: Name of the stream; it must allow direct gets.
        subject: May have wildcards.
        first: Sequence in the stream.
        last: Sequence of the last message of the subject.

    Raises:
        StreamError: The server does not answer, or refuses.
        nats.errors.Error: As above.
    """
    for _ in range(round(ANSWER_S / BEHIND_S)):
        async for batch in read_stream(nc, stream, subject, first=first):
            for message in batch:
                if message.sequence <= last:
                    yield message
            first = batch[-1].sequence + 1
            if first > last:
                return
        if (await nc.jetstream().stream_info(stream)).state.first_seq > last:
            return  # it has grown too old meanwhile
        await asyncio.sleep(BEHIND_S)
    raise StreamError(f"the server has lost message {last} of {stream}, or the node that answers is far behind")
