"""Layouts of records with single cells, one for each number of cells.

An earlier version reads such a record by the names of its fields, and drops the single cells.
"""

import json
from functools import lru_cache

from bms_estimator.fleet.worker.checkpoint.record_layout import layout_of
from bms_estimator.fleet.worker.pack_state import CELLS, MAX_CELLS, pack_dtype


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
