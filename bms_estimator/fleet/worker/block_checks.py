"""Checks of a block: number of its samples, and clock of its edge against the server's clock at its arrival.

An edge may deliver a block months after its samples, because it stores blocks while it has no link. It cannot deliver
samples of the future. Therefore the limits of the two directions differ.
"""

import math
from typing import NamedTuple

import numpy as np

from bms_estimator.edge.batching import MAX_SAMPLES as EDGE_MAX_SAMPLES
from bms_estimator.edge.block import Block
from bms_estimator.model.sample import SampleBlock

MAX_RATE_HZ = 1000.0
"""Maximum sample rate of a source [Hz]."""
MAX_SAMPLES = 20_000
"""Maximum number of samples in a block: the limit of earlier edge versions. Present edges use ``EDGE_MAX_SAMPLES``."""
MAX_TIMESTAMP_S = 2.0**33
"""Latest plausible timestamp [s since the creation of the store]. The limit allows for a store that was created in 1970
by a machine whose clock was not set."""


def density_fault(samples: SampleBlock) -> str:
    """Return the reason for which a block has too many samples; empty if the number is plausible.

    ``EDGE_MAX_SAMPLES`` are allowed beyond the rate, because an edge's clock may stand still while a source's is
    corrected.
    """
    if samples.size <= EDGE_MAX_SAMPLES:
        return ""
    if samples.size > MAX_SAMPLES:
        return f"{samples.size} samples: at most {MAX_SAMPLES}"
    times = samples["time_s"]
    plausible = times[(times >= 0.0) & (times <= MAX_TIMESTAMP_S)]
    elapsed_s = float(np.ptp(plausible)) if plausible.size else 0.0
    if samples.size <= EDGE_MAX_SAMPLES + MAX_RATE_HZ * elapsed_s:
        return ""
    return f"{samples.size} samples in {elapsed_s:.3g} s: at most {MAX_RATE_HZ:g} a second, and {EDGE_MAX_SAMPLES} more"


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
