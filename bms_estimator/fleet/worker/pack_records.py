"""Stored records of the packs of one partition, and the unpacked record into which they are loaded in turn."""

from collections import Counter
from typing import TYPE_CHECKING, NamedTuple

from bms_estimator.fleet.worker.checkpoint.checkpoint_format import PartitionCheckpoint
from bms_estimator.fleet.worker.checkpoint.record_layout import RecordWithLayout, cell_count, cell_layout, dtype_of
from bms_estimator.fleet.worker.pack_state import Fields, UnpackedRecord

if TYPE_CHECKING:
    import numpy as np


class CellPack(NamedTuple):
    """Packed record of a pack with single cells.

    Attributes:
        cells: Number of single cells.
        packed: The packed record.
    """

    cells: int
    packed: bytes


class PackRecords:
    """Packed records by pack. Each record has this version's layout from the first processed block on.

    Args:
        counters: Counters of the partition; updated.

    Attributes:
        unpacked: Record of the loaded pack.
    """

    def __init__(self, counters: Counter[str]) -> None:
        self.unpacked = UnpackedRecord()
        self._counters = counters
        self._packs: dict[str, bytes] = {}  # packs without single cells
        self._cell_packs: dict[str, CellPack] = {}
        self._unmigrated: dict[str, RecordWithLayout] = {}  # packs whose record has the layout of another version
        # delivery records of the unmigrated packs, updated since the partition was restored
        self._unmigrated_deliveries: dict[str, np.void] = {}

    def __len__(self) -> int:
        return len(self._packs) + len(self._cell_packs) + len(self._unmigrated)

    def restore(self, checkpoint: PartitionCheckpoint) -> None:
        """Add the records of a checkpoint."""
        self._packs.update(checkpoint.packs)
        for pack, record in checkpoint.other_layouts.items():
            if cells := cell_count(record.layout):
                self._cell_packs[pack] = CellPack(cells, record.packed)
            else:
                self._unmigrated[pack] = record

    def snapshot(self) -> tuple[dict[str, bytes], dict[str, RecordWithLayout]]:
        """Return ``packs`` and ``other_layouts`` of a checkpoint. Records are not copied, because they are immutable bytes."""
        with_cells = {
            pack: RecordWithLayout(cell_layout(cells), packed) for pack, (cells, packed) in self._cell_packs.items()
        }
        return dict(self._packs), self._unmigrated | with_cells

    def is_current(self, pack: str) -> bool:
        """Return True if the pack has a record in this version's layout."""
        return pack in self._packs or pack in self._cell_packs

    def has_cells(self, pack: str) -> bool:
        """Return True if the pack has a record with single cells, in this version's layout."""
        return pack in self._cell_packs

    def load(self, pack: str) -> Fields | None:
        """Load a pack into the unpacked record; a new pack has the initial record.

        Returns:
            The estimator fields by name if the estimator's part of the record has another layout; otherwise None.
        """
        packed = self._packs.get(pack)
        try:
            if packed is not None:
                self.unpacked.load(packed)
                return None
            if (cell_pack := self._cell_packs.get(pack)) is not None:
                self.unpacked.load(cell_pack.packed, cell_pack.cells)
                return None
            if (unmigrated := self._unmigrated.get(pack)) is not None:
                estimator_fields = self.unpacked.load_previous_layout(dtype_of(unmigrated.layout), unmigrated.packed)
                if estimator_fields is None:
                    self.store(pack)
                return estimator_fields
        except ValueError:  # does not happen with a checkpoint whose checksums were correct
            self._counters["damaged_states"] += 1
        self.unpacked.clear()
        return None

    def store(self, pack: str) -> None:
        """Store the unpacked record as that of a pack."""
        packed, cells = self.unpacked.packed_bytes(), self.unpacked.cell_count
        if cells:
            self._cell_packs[pack] = CellPack(cells, packed)
            self._packs.pop(pack, None)
        else:
            self._packs[pack] = packed
            self._cell_packs.pop(pack, None)
        self._unmigrated.pop(pack, None)
        self._unmigrated_deliveries.pop(pack, None)

    def load_unmigrated_delivery(self, pack: str) -> None:
        """Load the delivery record that ``store_unmigrated_delivery`` has stored, if any."""
        if pack in self._unmigrated_deliveries:
            self.unpacked.record["delivery"][0] = self._unmigrated_deliveries[pack]

    def store_unmigrated_delivery(self, pack: str) -> None:
        """Store only the delivery record of the loaded pack, whose record keeps its layout until a block is processed."""
        self._unmigrated_deliveries[pack] = self.unpacked.delivery.copy()
