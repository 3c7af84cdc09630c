"""Positions of packs in the last saved checkpoint, up to which an edge may delete its blocks.

A processed block is safe only when a saved checkpoint includes it. Until then the stream may drop it, for example while no
worker runs and the stream is full. The edge must therefore be able to send it again.
"""

from typing import NamedTuple


class BlockPosition(NamedTuple):
    """Block that a pack awaits."""

    store_ns: int
    """Creation time of the edge's store [ns since 1970]; 0: no block yet."""
    number: int
    """Number of the awaited block."""


class UnsavedPositions:
    """Saved positions of the packs that have processed blocks since the last saved checkpoint.

    A position that is not listed has not changed since the last saved checkpoint.
    """

    def __init__(self) -> None:
        self._before_snapshot: dict[str, BlockPosition] = {}  # saved with the last snapshot
        self._after_snapshot: dict[str, BlockPosition] = {}

    def add(self, pack: str, position: BlockPosition) -> None:
        """Record the position of a pack before a block. Only the first block after a snapshot has an effect."""
        self._after_snapshot.setdefault(pack, position)

    def begin_save(self) -> None:
        """Record that a snapshot of the partition was made."""
        self._before_snapshot = self._after_snapshot | self._before_snapshot
        self._after_snapshot = {}

    def end_save(self) -> None:
        """Record that the last snapshot was saved."""
        self._before_snapshot = {}

    def saved(self, pack: str, present: BlockPosition) -> BlockPosition:
        """Return the saved position of a pack.

        Args:
            pack: Name of the pack.
            present: Position of the pack in memory.

        Returns:
            The saved position; block 1 of the present store if no block of this store is saved.
        """
        position = self._before_snapshot.get(pack) or self._after_snapshot.get(pack) or present
        return position if position.store_ns == present.store_ns else BlockPosition(present.store_ns, 1)
