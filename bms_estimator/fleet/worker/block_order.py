"""Order of a pack's blocks, and replies to its edge. Both follow from the received blocks alone.

An edge stores each block until a reply says that all earlier blocks are safe. It resends from the expected block on. Therefore
late, repeated and early blocks can be dropped.
"""

from enum import Enum

import numpy as np

from bms_estimator.edge.block import Block
from bms_estimator.edge.subjects import BlockRequest
from bms_estimator.fleet.worker.pack_state import MAX_LOST

TOLD_EACH = 10
"""Number of blocks between two confirmations to an edge that earlier blocks are safe."""
ASKED_EACH = 5
"""Number of early blocks between two replies to an edge."""

MAX_PASSED = 20
"""Number of repetitions of the first later block after which missing blocks count as lost. The edge resends them all,
at least 30 s
apart, so the server refuses the missing ones, or they are damaged on the edge's disk."""


class BlockOrder(Enum):
    """Position of a block in the order of its pack."""

    NEXT = "next"
    RESENT = "resends"
    """Block was already taken."""
    AHEAD = "gaps"
    """One before it is missing."""
    FORMER_STORE = "former_store"
    """Block of an earlier store than the present one."""


def classify_block(d: np.void, block: Block) -> BlockOrder:
    """Classify a block by its header.

    Args:
        d: The pack's record of DELIVERY; updated but for ``NEXT`` itself, which ``mark_taken`` notes.
        block: The received block.
    """
    store, number = int(d["store"]), int(d["awaited"])
    if block.store < store:
        return BlockOrder.FORMER_STORE
    if block.store > store:
        d["store"], number = block.store, _await(d, 1)
    if block.oldest > number:
        number = _lose(d, block.oldest)
    if block.number < number:
        return BlockOrder.RESENT
    if block.number > number:
        d["ahead"] += 1
        _count_passed(d, block.number)
        if d["passed"] < MAX_PASSED:
            return BlockOrder.AHEAD
        _lose(d, block.number)
    return BlockOrder.NEXT


def mark_taken(d: np.void) -> None:
    """Advance to the block after the expected one; ``d`` as in ``classify_block``."""
    _await(d, int(d["awaited"]) + 1)
    d["blocks"] += 1


def _lose(d: np.void, number: int) -> int:
    """Count the blocks before a number as lost; returns the number."""
    d["lost_blocks"] = min(int(d["lost_blocks"]) + number - int(d["awaited"]), MAX_LOST)
    return _await(d, number)


def _count_passed(d: np.void, number: int) -> None:
    """Count the arrivals of the first block behind the missing ones."""
    if not d["first_ahead"] or number < d["first_ahead"]:
        d["first_ahead"], d["passed"] = number, 0
    d["passed"] += number == d["first_ahead"]


def _await(d: np.void, number: int) -> int:
    """Set the number of the awaited block, reset the counts of early blocks, and return the number."""
    d["awaited"], d["ahead"], d["first_ahead"], d["passed"] = number, 0, 0, 0
    return number


def edge_reply(order: BlockOrder, d: np.void, block: Block, *, first: bool) -> BlockRequest | None:
    """Return the reply to an edge about a block.

    Args:
        order: Order of the block.
        d: As in ``classify_block``, after the block.
        block: The received block.
        first: True for the first block of this pack since the takeover.
    """
    store, number = int(d["store"]), int(d["awaited"])
    if order is BlockOrder.AHEAD:
        due = first or int(d["ahead"]) % ASKED_EACH == 1
        return BlockRequest(store=store, number=number, resend=True) if due else None
    if first or block.number % TOLD_EACH == 0:
        return BlockRequest(store=store, number=number, resend=False)
    return None
