"""Order and plausibility of a pack's blocks, and replies to its edge. The order and the replies depend only on the received blocks.

A reply names the first block that is not safe (``UnsavedPositions``). It confirms all earlier blocks, which the edge may then
delete. On request, the edge resends the named block and all later blocks. Therefore late, repeated and early blocks can be
dropped.

A block is safe when two checkpoints that share no object include it, because then the damage of one object loses no block.
Until then the stream may drop the block, for example while no worker runs and the stream is full. The edge must therefore be
able to send it again.

The clock of an edge is compared with the server's clock at the arrival of a block. An edge may deliver a block months after its
samples, because it stores blocks while it has no link. It cannot deliver samples of the future. Therefore the limits of the two
directions differ.
"""

import math
from collections.abc import Collection
from enum import Enum
from typing import NamedTuple

import numpy as np

from bms_estimator.edge.batching import MAX_SAMPLES as EDGE_MAX_SAMPLES
from bms_estimator.edge.block import Block, BlockHeader
from bms_estimator.edge.subjects import BlockRequest
from bms_estimator.fleet.worker.pack_state import MAX_LOST_BLOCKS
from bms_estimator.model.arrays import SampleBlock

MAX_RATE_HZ = 1000.0
"""Maximum sample rate of a source [Hz]."""
MAX_SAMPLES = 20_000
"""Maximum number of samples in a block: the limit of earlier edge versions. Present edges use ``EDGE_MAX_SAMPLES``."""
MAX_TIMESTAMP_S = 2.0**33
"""Latest plausible timestamp [s since the creation of the store]. The limit allows for a store that was created in 1970
by a machine whose clock was not set."""


def density_fault(samples: SampleBlock) -> str:
    """Return the reason for which a block has too many samples; empty if the number is plausible.

    ``EDGE_MAX_SAMPLES`` are allowed beyond the rate, because timestamps may stand still while the clock of a source is corrected.
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


class BlockPosition(NamedTuple):
    """Block that a pack awaits."""

    store_ns: int
    """Creation time of the edge's store [ns since 1970]; 0: no block yet."""
    number: int
    """Number of the awaited block."""


class UnsavedPositions:
    """Positions of the packs of a partition at its last snapshot and saves.

    A pack is listed only if it has received a block since. The position of any other pack is the present one.
    """

    def __init__(self) -> None:
        self._at_snapshot: dict[str, BlockPosition] = {}  # positions in the last snapshot
        self._at_save: dict[str, BlockPosition] = {}  # positions in the last saved snapshot
        # positions in the checkpoint before the last whole one; None until this worker has saved a whole checkpoint
        self._safe: dict[str, BlockPosition] | None = None

    def add(self, pack: str, position: BlockPosition) -> None:
        """Record the position of a pack before a block. Only the first block after a snapshot has an effect."""
        self._at_snapshot.setdefault(pack, position)

    def begin_save(self) -> Collection[str] | None:
        """Record that a snapshot of the partition was made.

        Returns:
            The packs that were changed since the last save; None if this worker has not saved a whole checkpoint yet.
        """
        self._at_save = self._at_snapshot | self._at_save
        self._at_snapshot = {}
        return None if self._safe is None else frozenset(self._at_save)

    def end_save(self, *, is_whole: bool) -> None:
        """Record that the last snapshot was saved.

        Args:
            is_whole: True for a whole checkpoint; False for an increment of the last one.
        """
        if is_whole:
            self._safe = self._at_save
        elif self._safe is not None:
            self._safe = self._at_save | self._safe
        self._at_save = {}

    def safe(self, pack: str, present: BlockPosition) -> BlockPosition:
        """Return the position of a pack before which all blocks are safe.

        Args:
            pack: Name of the pack.
            present: Position of the pack in memory.

        Returns:
            The position; block 1 of the present store if no block of this store is safe.
        """
        none_safe = BlockPosition(present.store_ns, 1)
        if self._safe is None:
            return none_safe
        position = self._safe.get(pack) or self._at_save.get(pack) or self._at_snapshot.get(pack) or present
        return position if position.store_ns == present.store_ns else none_safe


CONFIRM_EVERY = 10
"""Number of blocks between two replies that confirm all earlier blocks."""
REQUEST_EVERY = 5
"""Number of early blocks between two replies that request a missing block."""

MAX_EARLY_REPEATS = 20
"""Number of arrivals of the first block after missing ones, at which the missing blocks count as lost.

The edge resends the missing blocks and all later blocks at intervals of at least 30 s. If only later blocks arrive, the
server rejects the missing blocks, or they are damaged on the edge's disk."""


class BlockOrder(Enum):
    """Position of a block in the order of its pack. Except for ``NEXT``, the value is the name of the partition's counter."""

    NEXT = "next"
    RESENT = "resends"
    """Already processed."""
    AHEAD = "gaps"
    """An earlier block is missing."""
    FORMER_STORE = "former_store"
    """From a store that is older than the store of the awaited block."""


def classify_block(delivery: np.void, block: BlockHeader) -> BlockOrder:
    """Classify a block, and update the pack's delivery record.

    Args:
        delivery: The pack's record of dtype ``DELIVERY``. The caller advances it past a ``NEXT`` block by ``mark_processed``.
        block: Header of the received block.
    """
    store, number = int(delivery["store"]), int(delivery["awaited"])
    if block.store_created_ns < store:
        return BlockOrder.FORMER_STORE
    if block.store_created_ns > store:
        delivery["store"], number = block.store_created_ns, _await_block(delivery, 1)
    if block.oldest > number:
        number = _skip_lost_blocks(delivery, block.oldest)
    if block.number < number:
        return BlockOrder.RESENT
    if block.number > number:
        delivery["ahead"] += 1
        _count_first_early_block(delivery, block.number)
        if delivery["passed"] < MAX_EARLY_REPEATS:
            return BlockOrder.AHEAD
        _skip_lost_blocks(delivery, block.number)
    return BlockOrder.NEXT


def mark_processed(delivery: np.void) -> None:
    """Record that the awaited block was processed, and await the next block.

    Args:
        delivery: The pack's record of dtype ``DELIVERY``.
    """
    _await_block(delivery, int(delivery["awaited"]) + 1)
    delivery["blocks"] += 1


def _skip_lost_blocks(delivery: np.void, number: int) -> int:
    """Count the missing blocks before ``number`` as lost, await block ``number``, and return ``number``."""
    delivery["lost_blocks"] = min(int(delivery["lost_blocks"]) + number - int(delivery["awaited"]), MAX_LOST_BLOCKS)
    return _await_block(delivery, number)


def _count_first_early_block(delivery: np.void, number: int) -> None:
    """Count the arrivals of the lowest early block."""
    if not delivery["first_ahead"] or number < delivery["first_ahead"]:
        delivery["first_ahead"], delivery["passed"] = number, 0
    delivery["passed"] += number == delivery["first_ahead"]


def _await_block(delivery: np.void, number: int) -> int:
    """Await block ``number``, reset the counts of early blocks, and return ``number``."""
    delivery["awaited"], delivery["ahead"], delivery["first_ahead"], delivery["passed"] = number, 0, 0, 0
    return number


def position(delivery: np.void) -> BlockPosition:
    """Return the position of a pack, from its record of dtype ``DELIVERY``."""
    return BlockPosition(int(delivery["store"]), int(delivery["awaited"]))


def edge_reply(
    order: BlockOrder, early_blocks: int, block: BlockHeader, safe: BlockPosition, *, is_first: bool
) -> BlockRequest | None:
    """Return the reply to a block's edge; None if no reply is due.

    Args:
        order: Result of ``classify_block``.
        early_blocks: Number of blocks that have arrived before the awaited one, including this one.
        block: Header of the received block.
        safe: Position of the pack before which all blocks are safe.
        is_first: True for the first block of this pack since the worker took over the partition.
    """
    store, number = safe
    if order is BlockOrder.AHEAD:
        # the first early block requests the missing one at once
        due = is_first or early_blocks % REQUEST_EVERY == 1
        return BlockRequest(store=store, number=number, resend=True) if due else None
    if is_first or block.number % CONFIRM_EVERY == 0:
        return BlockRequest(store=store, number=number, resend=False)
    return None
