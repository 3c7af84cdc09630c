"""Blocks of packs that the table does not know, kept until it does; bounded, whatever edges send."""

from collections.abc import Mapping

MOST_BLOCKS = 60
"""Of one pack: an hour of minute blocks. What comes then is dropped, and its edge asked for it once the pack is known."""
MOST_BYTES = 8 << 20
"""Of all packs of a partition."""
LEAST_BYTES = 1 << 10
"""What a block is counted as at least, so that many small ones of many names are bounded, too."""


class Held:
    """Blocks by pack, in the order in which they came."""

    def __init__(self) -> None:
        self._blocks: dict[str, tuple[bytes, ...]] = {}
        self._bytes = 0

    def __contains__(self, pack: str) -> bool:
        return pack in self._blocks

    def __len__(self) -> int:
        return len(self._blocks)

    def add(self, pack: str, data: bytes) -> bool:
        """Keep a block. False: there is no room, it is dropped."""
        before, counted = self._blocks.get(pack, ()), max(len(data), LEAST_BYTES)
        if len(before) >= MOST_BLOCKS or self._bytes + counted > MOST_BYTES:
            return False
        self._blocks[pack] = (*before, data)
        self._bytes += counted
        return True

    def release(self, pack: str) -> tuple[bytes, ...]:
        """The blocks of a pack, which are no longer held."""
        blocks = self._blocks.pop(pack, ())
        self._bytes -= sum(max(len(data), LEAST_BYTES) for data in blocks)
        return blocks

    def blocks(self) -> Mapping[str, tuple[bytes, ...]]:
        """What is held now."""
        return dict(self._blocks)
