"""Sizes of a tenant's streams, from the number of packs and the longest outage of the workers.

The sizes of a block, an hourly summary and a pack's state were measured with simulated packs at 1 Hz
(``tests/fleet/nats/test_stream_sizes.py`` prints them).
"""

import math
from dataclasses import dataclass

from bms_estimator.fleet.nats.streams import (
    DEAD_FRACTION,
    HOURS_FRACTION,
    MAX_BLOCK_BYTES,
    PACK_FRACTION,
    max_blocks_of_pack,
)

DAY_S = 86_400
"""Duration of a day [s]."""
DAY_BLOCKS = 1440
"""Number of minute blocks of a pack-day."""
BLOCK_S = 60.0
"""Duration of a minute block [s], whose size is ``block_bytes``."""
FIXED_FRACTION = 0.3
"""Size of a block without samples, as a fraction of a minute block. A block of 10 samples has 179 bytes, one of 60 has 509."""
BLOCK_BYTES = 800
"""Size of a block of 60 samples in ``RAW``, with the server's overhead [bytes]."""
HOUR_ROW_BYTES = 1900
"""Size of an hourly summary in ``HOURS``, with the server's overhead [bytes]."""
STATE_BYTES = 46_000
"""Maximum size of a pack in a checkpoint [bytes]."""
DAILY_STATE_BYTES = 26_000
"""Size of a pack in a daily checkpoint [bytes], measured after 24 h with a fit."""
HISTORY_BYTES = 1_000_000
"""Maximum size of a pack's history with its last fit [bytes]."""
CELL_BLOCK_BYTES = 60
"""Additional size of a block of 60 samples for the voltages of each cell [bytes]."""
MEAN_VOLTAGE_BLOCK_BYTES = 160
"""Additional size of a block of 60 samples for the mean voltages of the cells [bytes]."""
MAX_CELLS_BLOCK_BYTES = 4096
"""Maximum additional size of a block with cell voltages [bytes]. From 67 cells on, not all samples have cell voltages
(``edge.cell_voltages``)."""
CELL_STATE_BYTES = 400
"""Additional size of a pack in a checkpoint for each cell [bytes]."""
LAST_CHECKPOINTS = 4
"""Size of the last checkpoints of a partition, in checkpoints without increments: two with increments of at most half their size,
and the one that is being written."""
DAILY_CHECKPOINTS = 30
"""Maximum number of daily checkpoints of a partition."""
MIN_STATES_BYTES = 256 << 20
"""Minimum size of the checkpoints' stream [bytes]: 64 partitions without packs, each with all its checkpoints."""


@dataclass(frozen=True)
class StreamSizes:
    """Maximum sizes of a tenant's streams [bytes]."""

    raw: int
    """Stream ``RAW``."""
    states: int
    """Stream ``OBJ_states``."""
    history: int
    """Stream ``HISTORY``."""
    pack_blocks: int
    """Maximum number of blocks of one pack in ``RAW``."""

    @property
    def total(self) -> int:
        """All streams, including ``HOURS`` and ``DEAD``, whose sizes are fractions of that of ``RAW``."""
        return round(self.raw * (1.0 + HOURS_FRACTION + DEAD_FRACTION)) + self.states + self.history


def stream_sizes(packs: int, outage_days: float, cells: int = 0, block_s: float = BLOCK_S) -> StreamSizes:
    """Return the sizes of the streams for a number of packs.

    Args:
        packs: Number of packs of the tenant.
        outage_days: Time without workers for which ``RAW`` holds all blocks [days], even if one pack sends blocks of the
            maximum size once a minute.
        cells: Number of single cells of a pack whose voltages are sent.
        block_s: Duration of a block [s].
    """
    outage_blocks = outage_days * DAY_S / block_s
    mean_bytes = block_bytes(cells) * (FIXED_FRACTION + (1.0 - FIXED_FRACTION) * block_s / BLOCK_S)
    fleet_bytes = packs * outage_blocks * mean_bytes
    one_pack_bytes = outage_days * DAY_BLOCKS * MAX_BLOCK_BYTES / PACK_FRACTION
    checkpoints = LAST_CHECKPOINTS + DAILY_CHECKPOINTS
    states_bytes = packs * (
        LAST_CHECKPOINTS * STATE_BYTES + DAILY_CHECKPOINTS * DAILY_STATE_BYTES + checkpoints * cells * CELL_STATE_BYTES
    )
    raw_bytes = round(max(fleet_bytes, one_pack_bytes))
    return StreamSizes(
        raw_bytes,
        states=max(states_bytes, MIN_STATES_BYTES),
        history=packs * HISTORY_BYTES,
        pack_blocks=max(max_blocks_of_pack(raw_bytes), math.ceil(outage_blocks)),
    )


def block_bytes(cells: int) -> int:
    """Return the size of a block of 60 samples with the voltages of ``cells`` cells in ``RAW`` [bytes]."""
    cells_bytes = min(MEAN_VOLTAGE_BLOCK_BYTES + CELL_BLOCK_BYTES * cells, MAX_CELLS_BLOCK_BYTES) if cells else 0
    return BLOCK_BYTES + cells_bytes
