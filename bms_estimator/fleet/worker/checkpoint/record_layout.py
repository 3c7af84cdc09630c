"""Layout of a pack's record in a checkpoint: the names, types and order of its fields.

A version with other fields can therefore restore the record by the names of its fields.

Records with single cells have a layout for each number of cells. An earlier version reads such a record by the names of its
fields, and drops the single cells.
"""

import json
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from bms_estimator.fleet.worker.pack_state import CELLS, MAX_CELLS, PACK_STATE, pack_dtype
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
    """Return the number of single cells of this version's records with this layout; 0 for any other layout."""
    fields = {name: shape for name, _, shape in json.loads(layout)}
    (cells,) = fields.get(CELLS) or (0,)
    return cells if 0 < cells <= MAX_CELLS and cell_layout(cells) == layout else 0
