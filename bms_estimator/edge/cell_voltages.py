"""Compact form of the cell voltages in a block: the mean of the cells, and the difference of each cell from it.

Layout, little-endian, before compression::

    stride  u2               every stride-th sample of the block has cell voltages
    means   u4 x rows        mean of the cells, in units of 0.2 mV, as differences of successive rows
    cells   u2 x rows, m     cell minus mean, in units of 0.2 mV, as differences of successive rows, cell after cell

Differences wrap around. The cells of a pack differ little and slowly, so that most of these numbers are 0 and compress well.
A multiple of 0.2 mV, as reported by battery management systems, is restored exactly.
"""

import math
import warnings

import numpy as np

from bms_estimator.model.arrays import CellBlock

MAX_CELLS = 255
"""Maximum number of cells in series."""
MAX_BYTES = 8192
"""Maximum size before compression [bytes]. With this size, a block of ``batching.MAX_SAMPLES`` incompressible samples stays below
the server's limit. If the voltages of all samples would be larger, only every second (third, ...) sample has them."""
MAX_V = 100.0
"""Maximum magnitude of a voltage [V]; a larger one is not sent."""
UNITS_PER_V = 5000.0
_STRIDE_BYTES, _MEAN_BYTES, _CELL_BYTES = 2, 4, 2
_NO_MEAN, _NO_CELL, _MAX_DIFFERENCE = -(2**31), -(2**15), 2**15 - 1


def encode_cells(cells_v: CellBlock) -> bytes:
    """Encode cell voltages.

    Args:
        cells_v: Shape (n, m) [V], NaN if not reported, with m from 1 to ``MAX_CELLS``.

    Raises:
        ValueError: There is no cell, or more than ``MAX_CELLS``.
    """
    samples, cells = cells_v.shape
    if not 1 <= cells <= MAX_CELLS:
        raise ValueError(f"{cells} cells in a block: must be 1 to {MAX_CELLS}")
    max_rows = (MAX_BYTES - _STRIDE_BYTES) // _row_bytes(cells)
    stride = math.ceil(samples / max_rows)
    picked = np.where(np.abs(cells_v[::stride]) <= MAX_V, cells_v[::stride], np.nan)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # rows without a voltage
        mean = np.round(UNITS_PER_V * np.nanmean(picked, axis=1))
    difference = np.clip(np.round(UNITS_PER_V * picked) - mean[:, None], -_MAX_DIFFERENCE, _MAX_DIFFERENCE)
    means = np.where(np.isfinite(mean), mean, _NO_MEAN).astype("<i4").view("<u4")
    differences = np.where(np.isfinite(difference), difference, _NO_CELL).astype("<i2").view("<u2")
    return b"".join(
        [
            stride.to_bytes(_STRIDE_BYTES, "little"),
            np.diff(means, prepend=means.dtype.type(0)).tobytes(),
            np.diff(differences, axis=0, prepend=np.zeros((1, cells), differences.dtype)).T.tobytes(),
        ]
    )


def decode_cells(data: bytes, samples: int, cells: int) -> CellBlock:
    """Decode cell voltages, shape (samples, cells) [V]; NaN if not reported or not sent.

    Raises:
        ValueError: The bytes do not hold these voltages.
    """
    stride = int.from_bytes(data[:_STRIDE_BYTES], "little")
    rows = math.ceil(samples / stride) if stride else 0
    if not rows or len(data) != _STRIDE_BYTES + rows * _row_bytes(cells):
        raise ValueError(f"{len(data)} bytes do not hold the voltages of {cells} cells")
    means = np.cumsum(np.frombuffer(data, "<u4", rows, _STRIDE_BYTES), dtype="<u4").view("<i4")
    offset = _STRIDE_BYTES + rows * _MEAN_BYTES
    columns = np.frombuffer(data, "<u2", rows * cells, offset).reshape(cells, rows)
    differences = np.cumsum(columns, axis=1, dtype="<u2").view("<i2").T
    is_known = (means[:, None] != _NO_MEAN) & (differences != _NO_CELL)
    cells_v = np.full((samples, cells), np.nan)
    cells_v[::stride] = np.where(is_known, (means[:, None].astype("f8") + differences) / UNITS_PER_V, np.nan)
    return cells_v


def _row_bytes(cells: int) -> int:
    """Return the size of the cell voltages of one sample [bytes]."""
    return _MEAN_BYTES + cells * _CELL_BYTES
