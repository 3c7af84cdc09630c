"""Stored records of the packs of one partition, the unpacked record into which they are loaded in turn, and their layouts.

The layout of a record in a checkpoint is the names, types and order of its fields. A version with other fields can therefore
restore the record by the names of its fields. Records with single cells have a layout for each number of cells. An earlier version
reads such a record by the names of its fields, and drops the single cells.
"""

import json
from collections import Counter
from collections.abc import Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from bms_estimator.fleet.worker.pack_state import CELLS, MAX_CELLS, PACK_STATE, Fields, UnpackedRecord, pack_dtype
from bms_estimator.kernels.packed_record import symmetry_map

_MAX_RECORD_BYTES = 1 << 24
"""Maximum size of a record that a layout from a checkpoint may describe [bytes]."""


class RecordWithLayout(NamedTuple):
    """Packed record whose layout is not ``CURRENT_LAYOUT``: of another version, or with single cells."""

    layout: str
    packed: bytes


def layout_of(dtype: np.dtype[Any]) -> str:
    """Return the fields of a record dtype as JSON text."""
    return json.dumps(_layout_fields(dtype), separators=(",", ":"))


def dtype_of(layout: str) -> np.dtype[Any]:
    """Return the dtype that ``layout_of`` describes.

    Raises:
        ValueError: The text does not describe a record.
    """
    try:
        dtype = np.dtype(_dtype_fields(json.loads(layout)))
    except (TypeError, KeyError, IndexError, RecursionError, OverflowError) as error:
        raise ValueError(f"no layout of a record: {error}") from None
    if dtype.itemsize > _MAX_RECORD_BYTES:
        raise ValueError(f"{dtype.itemsize} bytes: no layout of a pack's record")
    symmetry_map(dtype)  # raises ValueError if the record does not consist of whole words
    return dtype


def _layout_fields(dtype: np.dtype[Any]) -> list[Any]:
    return [
        [name, _layout_fields(part.base) if part.base.names else part.base.str, list(part.shape)]
        for name, (part, *_) in (dtype.fields or {}).items()
    ]


def _dtype_fields(layout: Any) -> list[Any]:
    return [
        (name, _dtype_fields(part) if isinstance(part, list) else part, tuple(shape)) for name, part, shape in layout
    ]


CURRENT_LAYOUT = layout_of(PACK_STATE)
"""Layout of a pack's record in this version."""


@lru_cache(maxsize=MAX_CELLS)
def cell_layout(cells: int) -> str:
    """Return the layout of a record with ``cells`` single cells."""
    return layout_of(pack_dtype(cells))


@lru_cache(maxsize=2 * MAX_CELLS)
def cell_count(layout: str) -> int:
    """Return the number of single cells in a layout of this version; 0 without single cells, or for another version."""
    fields = {name: shape for name, _, shape in json.loads(layout)}
    (cells,) = fields.get(CELLS) or (0,)
    return cells if 0 < cells <= MAX_CELLS and cell_layout(cells) == layout else 0


class PackRecord(NamedTuple):
    """Packed record of a pack in this version's layout.

    Attributes:
        packed: The packed record.
        cells: Number of single cells; 0 without cell voltages.
    """

    packed: bytes
    cells: int = 0


class PackRecords:
    """Packed records by pack. A record gets this version's layout when a block is processed.

    Args:
        counters: Counters of the partition; updated.

    Attributes:
        unpacked: Record of the loaded pack.
    """

    def __init__(self, counters: Counter[str]) -> None:
        self.unpacked = UnpackedRecord()
        self._counters = counters
        self._packs: dict[str, PackRecord] = {}
        self._unmigrated: dict[str, RecordWithLayout] = {}  # packs whose record has the layout of another version
        # delivery records of the unmigrated packs, updated since the partition was restored
        self._unmigrated_deliveries: dict[str, np.void] = {}

    def __len__(self) -> int:
        return len(self._packs) + len(self._unmigrated)

    def restore(self, packs: Mapping[str, bytes], other_layouts: Mapping[str, RecordWithLayout]) -> None:
        """Add the records of a checkpoint (``PartitionCheckpoint``)."""
        self._packs.update((pack, PackRecord(packed)) for pack, packed in packs.items())
        for pack, record in other_layouts.items():
            if cells := cell_count(record.layout):
                self._packs[pack] = PackRecord(record.packed, cells)
            else:
                self._unmigrated[pack] = record

    def snapshot(self) -> tuple[dict[str, bytes], dict[str, RecordWithLayout]]:
        """Return ``packs`` and ``other_layouts`` of a checkpoint. Records are not copied, because they are immutable bytes."""
        with_cells = {
            pack: RecordWithLayout(cell_layout(cells), packed) for pack, (packed, cells) in self._packs.items() if cells
        }
        return {
            pack: packed for pack, (packed, cells) in self._packs.items() if not cells
        }, self._unmigrated | with_cells

    def is_current(self, pack: str) -> bool:
        """Return True if the pack has a record in this version's layout."""
        return pack in self._packs

    def load(self, pack: str) -> Fields | None:
        """Load a pack into the unpacked record; a new pack has the initial record.

        Returns:
            The estimator fields by name if the estimator's part of the record has another layout; otherwise None.
        """
        try:
            if (record := self._packs.get(pack)) is not None:
                self.unpacked.load(*record)
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
        """Store the unpacked record as the record of a pack."""
        self._packs[pack] = PackRecord(self.unpacked.packed_bytes(), self.unpacked.cell_count)
        self._unmigrated.pop(pack, None)
        self._unmigrated_deliveries.pop(pack, None)

    def load_unmigrated_delivery(self, pack: str) -> None:
        """Load the delivery record that ``store_unmigrated_delivery`` has stored, if any."""
        if pack in self._unmigrated_deliveries:
            self.unpacked.record["delivery"][0] = self._unmigrated_deliveries[pack]

    def store_unmigrated_delivery(self, pack: str) -> None:
        """Store only the delivery record of the loaded pack, whose record keeps its layout until a block is processed."""
        self._unmigrated_deliveries[pack] = self.unpacked.delivery.copy()
