"""Columns of single cells in a table of estimates, such as that of ``replay --out``."""

import itertools
import math

import numpy as np

from bms_estimator.estimator.cell_estimator import CellDeviations, CellEstimator
from bms_estimator.estimator.estimator import TraceBlock
from bms_estimator.model.arrays import Records
from bms_estimator.model.sample import CellBlock, SampleBlock
from bms_estimator.telemetry.cells import weakest_cell_fields

CELL_COLUMNS = np.dtype(
    [
        ("weakest_cell", "f8"),  # number of the cell with the lowest SOC, from 1
        ("weakest_cell_soc", "f8"),  # its SOC, 0..1
        ("weakest_cell_soc_std", "f8"),  # standard deviation of this SOC
        ("cell_soc_spread", "f8"),  # highest minus lowest SOC of the cells
        ("cell_r_spread", "f8"),  # highest minus lowest resistance, relative to the median
    ]
)
"""Values of a row; NaN before the first estimate of the cells."""
INTERVAL_S = 10.0
"""Interval at which the values are updated [s]. It equals the averaging window of the cell estimator."""


class CellColumns:
    """Collector of the columns of single cells, one row for each row of the trace.

    Args:
        cells: Estimator of the single cells of the pack.
    """

    def __init__(self, cells: CellEstimator) -> None:
        self._cells = cells
        self._parts: list[Records] = []
        self._has_columns: bool | None = None  # None before the first rows

    @property
    def deviations(self) -> CellDeviations | None:
        """Deviations of the cells at the end of the last window; None before the first window with cell voltages."""
        return self._cells.deviations

    def run(self, samples: SampleBlock, cells_v: CellBlock, trace: TraceBlock) -> None:
        """Process a block with ``CellEstimator.run`` in parts of ``INTERVAL_S``, and append the values after each part to its rows.

        Args:
            samples: Samples of the block, including rejected ones.
            cells_v: Cell voltages of the samples, shape (n, m) [V]; empty without any.
            trace: Estimates of the accepted samples.
        """
        columns, accepted = np.empty(trace.size, CELL_COLUMNS), _accepted_indices(samples, trace)
        edges = [0, *(np.flatnonzero(np.diff(trace["time_s"] // INTERVAL_S)) + 1).tolist(), trace.size]
        for first, last in itertools.pairwise(edges):
            part = accepted[first:last]
            self._cells.run(samples[part], cells_v[part] if cells_v.size else cells_v, trace[first:last])
            columns[first:last] = _values(self._cells)
        self._parts.append(columns)

    def take_rows(self, count: int) -> tuple[Records, ...]:
        """Return the values of the rows processed since the last call, and clear them.

        Args:
            count: Number of rows of the table. Rows before the first block with cell voltages are NaN.

        Returns:
            A tuple with one array of dtype ``CELL_COLUMNS``, shape (count,). If the first call finds no cell voltages, the tuple is
            empty in all calls, because all rows of a table have the same columns.
        """
        parts, self._parts = self._parts, []
        if self._has_columns is None:
            self._has_columns = bool(parts)
        if not self._has_columns:
            return ()
        missing = count - sum(part.size for part in parts)
        return (np.concatenate([np.full(missing, math.nan).astype(CELL_COLUMNS), *parts]),)


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
    """Return the present values in the order of ``CELL_COLUMNS``."""
    names = CELL_COLUMNS.names or ()
    if cells.deviations is None:
        return (math.nan,) * len(names)
    fields = weakest_cell_fields(cells.deviations)
    return tuple(math.nan if (value := fields[name]) is None else float(value) for name in names)
