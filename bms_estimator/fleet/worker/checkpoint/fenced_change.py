"""Change of a partition's checkpoints from outside its worker.

The change claims the partition as a worker does. The owner is thereby fenced out, drops the partition from its memory, and
takes it over again from the changed checkpoints.
"""

import asyncio
import json
from collections.abc import Awaitable, Callable
from contextlib import suppress

import nats.errors
from nats.aio.client import Client

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.streams import GROUP, RESPONSE_TIMEOUT_S, consumer
from bms_estimator.fleet.worker.checkpoint.claims import FencedError
from bms_estimator.model.errors import UserError

MAX_CLAIMS = 20
"""Maximum number of claims of a partition, because its worker may claim it again before its checkpoints are changed."""
RETRY_S = 0.5
"""Delay before a partition is claimed again [s]."""


async def change_checkpoints(nc: Client, partition: int, change: Callable[[], Awaitable[None]]) -> None:
    """Change the checkpoints of a partition, and let its worker take it over again.

    Args:
        nc: Connection to the tenant's NATS account.
        partition: Number of the partition.
        change: Claims the partition and changes its checkpoints. It is repeated if a worker claims the partition meanwhile.

    Raises:
        UserError: A worker claims the partition at each attempt.
    """
    for _ in range(MAX_CLAIMS):
        try:
            await change()
            break
        except FencedError:
            await asyncio.sleep(RETRY_S)
    else:
        raise UserError(
            f"partition {partition}: its worker claims it at each attempt; end the workers and repeat the command"
        )
    # a worker whose pin ends checks its claim, finds it replaced, and drops the partition from its memory
    request = f"$JS.API.CONSUMER.UNPIN.{subjects.RAW_STREAM}.{consumer(partition)}"
    with suppress(nats.errors.TimeoutError):
        await nc.request(request, json.dumps({"group": GROUP}).encode(), timeout=RESPONSE_TIMEOUT_S)
