"""Open blocks of all packs: division of their samples into numbered blocks. No I/O."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import structlog

from bms_estimator.edge.batching import Batcher, ReadyBlock
from bms_estimator.edge.block_sender import MAX_BLOCK_AGE
from bms_estimator.fleet.ingest.batch_samples import BatchSamples, Selection, select_new
from bms_estimator.fleet.ingest.store_table import NumberedBlock, PackPosition

NO_POSITION = PackPosition(0, 1, -math.inf)
"""Position of a pack without blocks."""

log = structlog.get_logger(__name__)


@dataclass
class _OpenPack:
    """Samples of a pack that are in no block yet."""

    batcher: Batcher
    position: PackPosition
    last_s: float
    """Time of the last sample [s since 1970]."""
    first_sequence: int = 0
    """Sequence number of the message with the first sample of the open block."""
    opened_s: float = 0.0
    """Monotonic time of the first sample's arrival [s]."""


class OpenBlocks:
    """Samples of all packs that are in no block yet, and the blocks made of them.

    Args:
        block_s: Duration of a block [s].

    Attributes:
        completed: Completed blocks; emptied by the caller.
        changed: Positions that have changed since the caller emptied it.
    """

    def __init__(self, block_s: float) -> None:
        self._block_s = block_s
        self._packs: dict[str, _OpenPack] = {}
        self.completed: list[NumberedBlock] = []
        self.changed: dict[str, PackPosition] = {}

    def __contains__(self, pack: object) -> bool:
        return pack in self._packs

    def __iter__(self) -> Iterator[str]:
        return iter(self._packs)

    def set_position(self, pack: str, position: PackPosition) -> None:
        """Set the position of a pack, and discard its open block."""
        self._packs[pack] = _OpenPack(Batcher(self._block_s), position, position.last_s)

    def remove(self, pack: str) -> None:
        """Remove a pack, its open block, and its blocks in ``completed``."""
        self._packs.pop(pack, None)
        self.changed.pop(pack, None)
        self.completed = [block for block in self.completed if block.pack != pack]

    def position(self, pack: str) -> PackPosition:
        """Return the position of a pack."""
        return self._packs[pack].position

    def last_s(self, pack: str) -> float:
        """Return the time of a pack's last sample [s since 1970]."""
        return self._packs[pack].last_s

    def add(self, pack: str, batch: BatchSamples, arrival_s: float, now_s: float, sequence: int) -> Selection:
        """Add the new samples of a batch, and return them with the numbers of dropped samples.

        If a block cannot be encoded, nothing changes, so that only this batch is rejected.

        Args:
            pack: Name of the pack, whose position is set.
            batch: Samples of the batch.
            arrival_s: Time of arrival of the batch [s since 1970].
            now_s: Monotonic time [s].
            sequence: Sequence number of the message.

        Raises:
            Exception: A block with samples of the batch cannot be encoded.
        """
        open_pack = self._packs[pack]
        selection = select_new(batch, open_pack.last_s, arrival_s)
        if not selection.samples.size:
            return selection
        batcher = open_pack.batcher.copy()
        completed = batcher.add(selection.samples, arrival_s, selection.cells_v)
        self._complete(pack, open_pack, completed)
        if completed or not len(open_pack.batcher):
            open_pack.first_sequence, open_pack.opened_s = sequence, now_s
        open_pack.batcher, open_pack.last_s = batcher, float(selection.samples["time_s"][-1])
        return selection

    def complete(self, now_s: float = math.inf) -> None:
        """Complete the open blocks that are older than ``MAX_BLOCK_AGE`` times the duration of a block; by default all.

        The samples of a block that cannot be encoded are dropped, so that the other packs continue.
        """
        for pack, open_pack in self._packs.items():
            if len(open_pack.batcher) and now_s - open_pack.opened_s > MAX_BLOCK_AGE * self._block_s:
                try:
                    self._complete(pack, open_pack, open_pack.batcher.cut())
                except Exception:
                    log.exception("samples of an open block are dropped, because it cannot be encoded", pack=pack)

    def first_sequence(self, default: int) -> int:
        """Return the smallest sequence number of a message with samples of open blocks; ``default`` without open blocks."""
        sequences = (open_pack.first_sequence for open_pack in self._packs.values() if len(open_pack.batcher))
        return min(sequences, default=default)

    def _complete(self, pack: str, open_pack: _OpenPack, completed: list[ReadyBlock]) -> None:
        position, blocks = open_pack.position, list[NumberedBlock]()
        for ready in completed:
            number, position = position.next_number, position.after(ready)
            blocks.append(NumberedBlock.of(pack, number, position.created_s, ready))
        if blocks:
            self.completed += blocks
            open_pack.position = self.changed[pack] = position
