"""Columns of the cells in a table of estimates, such as that of ``replay --out``."""

import itertools
import math

import numpy as np

from bms_estimator.estimator.cell_estimator import CellEstimator
from bms_estimator.estimator.estimator import TraceBlock
from bms_estimator.model.arrays import Records
from bms_estimator.model.sample import CellBlock, SampleBlock
from bms_estimator.telemetry.cells import weakest_cell_fields

CELL_COLUMNS = np.dtype(
    [
        ("weakest_cell", "f8"),  # number of the cell with the lowest SOC, from 1
        ("weakest_cell_soc", "f8"),  # its SOC, 0..1
        ("weakest_cell_soc_std", "f8"),  # standard deviation of this SOC
        ("cell_soc_spread", "f8"),  # highest less lowest SOC of the cells
        ("cell_r_spread", "f8"),  # highest less lowest resistance, relative to the median
    ]
)
"""Values of a row; NaN before the first estimate of the cells."""
INTERVAL_S = 10.0
"""Interval at which the values change [s]."""


class CellColumns:
    """Estimators of the single cells of a pack, with their values at each row of the trace.

    Args:
        cells: The estimators.

    Attributes:
        rows: Values at each row of the last block, dtype ``CELL_COLUMNS``, as the only item; empty if the first block had no
            cell voltages.
    """

    def __init__(self, cells: CellEstimator) -> None:
        self._cells = cells
        self._measured: bool | None = None  # None before the first block
        self.rows = tuple[Records, ...]()

    def run(self, samples: SampleBlock, cells_v: CellBlock, trace: TraceBlock) -> None:
        """Process a block like ``CellEstimator.run``, in parts of ``INTERVAL_S``."""
        if self._measured is None:
            self._measured = cells_v.size > 0
        if not self._measured:
            return
        columns, accepted = np.empty(trace.size, CELL_COLUMNS), _accepted_indices(samples, trace)
        edges = [0, *(np.flatnonzero(np.diff(trace["time_s"] // INTERVAL_S)) + 1).tolist(), trace.size]
        for first, last in itertools.pairwise(edges):
            part = accepted[first:last]
            self._cells.run(samples[part], cells_v[part] if cells_v.size else cells_v, trace[first:last])
            columns[first:last] = _values(self._cells)
        self.rows = (columns,)


def _accepted_indices(samples: SampleBlock, trace: TraceBlock) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Return the index of the sample of each row of the trace."""
    if samples.size == trace.size:
        return np.arange(trace.size)
    indices, i = np.empty(trace.size, np.int64), 0
    times_s = samples["time_s"].tolist()
    for row, time_s in enumerate(trace["time_s"].tolist()):
        while times_s[i] != time_s:  # the sample was rejected
            i += 1
        indices[row], i = i, i + 1
    return indices


def _values(cells: CellEstimator) -> tuple[float, ...]:
    names = CELL_COLUMNS.names or ()
    if cells.deviations is None:
        return (math.nan,) * len(names)
    fields = weakest_cell_fields(cells.deviations)
    return tuple(math.nan if (value := fields[name]) is None else float(value) for name in names)
