"""What a pack has sent, fetched from the stream of blocks."""

import math

from nats.aio.client import Client

from bms_estimator.edge.subjects import RAW_STREAM
from bms_estimator.fleet.identification.block_capture import Captured
from bms_estimator.fleet.nats.stream_reader import read_stream

AHEAD_S = 3600.0
"""The edges' clocks are ahead of the server's by no more: a block is kept at most so long before its samples' time [s]."""


async def fetch(nc: Client, pack: str, *, since_s: float = -math.inf, until_s: float = math.inf) -> Captured:
    """The blocks of a pack that the stream still has.

    Args:
        nc: Connected as the tenant.
        pack: Its name.
        since_s: Samples from then on, by the edge's clock [s since 1970].
        until_s: Samples before it.

    Raises:
        StreamError: The server does not answer, or has no such stream.
    """
    found = Captured(since_s, until_s)
    first_s = None if since_s <= AHEAD_S else since_s - AHEAD_S
    async for batch in read_stream(nc, RAW_STREAM, f"p.*.raw.{pack}", since_s=first_s):
        for message in batch:
            found.add(message.data)
    return found
