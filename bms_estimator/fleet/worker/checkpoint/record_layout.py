"""Layout of a pack's record in a checkpoint: the names, types and order of its fields.

A version with other fields can therefore restore the record by the names of its fields.
"""

import json
from typing import Any, NamedTuple

import numpy as np

from bms_estimator.fleet.worker.pack_state import PACK_STATE
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
