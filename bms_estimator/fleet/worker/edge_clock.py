"""Error of an edge's clock against the server's clock at the arrival of a block.

An edge may deliver a block months after its samples, because it stores blocks while it has no link. It cannot deliver
samples of the future. Therefore the limits of the two directions differ.
"""

import math
from typing import NamedTuple

from bms_estimator.edge.block import Block

MAX_AHEAD_S = 600.0
"""Maximum time by which a block's last sample may be later than its arrival at the server [s]. It exceeds the error of
an undisciplined clock after a week (100 ppm), and is below the smallest error of a time zone, half an hour."""
MAX_BEHIND_S = 366 * 86_400.0
"""Maximum time by which a block's last sample may be earlier than its arrival at the server [s]. A store of the default
size holds about four months of blocks. A clock without a battery starts in 1970 or in the year of its production."""


class Arrival(NamedTuple):
    """Arrival of a message at the server, which is equal for each worker that processes the message."""

    sequence: int
    """Stream sequence number."""
    received_s: int | None = None
    """Whole seconds since 1970 on the server's clock; None: unknown, so that the edge's clock is not checked."""


def last_sample_s(block: Block) -> float:
    """Return the time of a block's last sample on the edge's clock [s since 1970].

    If this time is not finite, return the creation time of the edge's store.
    """
    last_s = float(block.samples["time_s"][-1])
    return block.store_created_ns / 1e9 + (last_s if math.isfinite(last_s) else 0.0)


def clock_error_s(block: Block, received_s: int | None) -> float:
    """Return the error of the edge's clock [s], positive if it is ahead; 0 within ``MAX_AHEAD_S`` and ``MAX_BEHIND_S``.

    Args:
        block: Block of samples.
        received_s: Server's clock at the arrival of the block [s since 1970]; None: unknown, which gives 0.
    """
    if received_s is None:
        return 0.0
    ahead_s = last_sample_s(block) - received_s
    return 0.0 if -MAX_BEHIND_S <= ahead_s <= MAX_AHEAD_S else ahead_s
