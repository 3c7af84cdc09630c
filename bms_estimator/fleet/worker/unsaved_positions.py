"""Saved positions of packs, up to which an edge may delete its blocks, and packs that were changed since the last save.

A block is safe when two checkpoints that share no object include it, because then the damage of one object loses no block.
Until then the stream may drop the block, for example while no worker runs and the stream is full. The edge must therefore be
able to send it again.
"""

from collections.abc import Collection
from typing import NamedTuple


class BlockPosition(NamedTuple):
    """Block that a pack awaits."""

    store_ns: int
    """Creation time of the edge's store [ns since 1970]; 0: no block yet."""
    number: int
    """Number of the awaited block."""


class UnsavedPositions:
    """Positions of the packs of a partition that blocks have changed since the last saves.

    A position that is not listed has not changed.
    """

    def __init__(self) -> None:
        self._at_snapshot: dict[str, BlockPosition] = {}  # positions at the last snapshot
        self._at_save: dict[str, BlockPosition] = {}  # positions at the last save
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
