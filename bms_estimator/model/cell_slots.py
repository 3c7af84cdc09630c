"""Selection of the cells of a pack from the cell slots that its device reports."""

import numpy as np
from numpy.typing import NDArray

from bms_estimator.model.arrays import Floats
from bms_estimator.model.sample import CellBlock

MIN_CELL_V, MAX_CELL_V = 0.1, 6.0
"""Range of the absolute voltage of a live cell [V]. Empty slots read 0 V, a few millivolts of noise, or the largest number of
their format. No single cell exceeds 5 V."""


class CellSlots:
    """Cell slots of one device.

    Many devices report more slots than their pack has cells. The live slots are the cells if there are as many of them as
    cells in series. These slots remain the cells when a cell fails. Until then the first slots are the cells. The division of
    the samples into blocks does not change the selection.

    Args:
        series: Number of cells in series.

    Attributes:
        fault: Fault of the last block if it has more live slots than cells in series, as a sentence; empty otherwise.
    """

    def __init__(self, series: int) -> None:
        self._series, self._slots, self.fault = series, np.arange(series), ""

    def select(self, cells_v: CellBlock) -> CellBlock:
        """Return the voltages of the cells [V], shape (n, m) with at most ``series`` columns.

        A sample with more live slots than cells in series has no cell voltages (NaN), because nothing shows which slots
        belong to the pack.

        Args:
            cells_v: Voltages of the slots [V], NaN if not measured, shape (n, slots).
        """
        self.fault = ""
        is_within_series = cells_v.shape[1] <= self._series and self._slots[-1] < self._series
        if is_within_series or not cells_v.size:
            return cells_v
        missing = max(int(self._slots[-1]) + 1 - cells_v.shape[1], 0)
        slots_v = np.pad(cells_v, ((0, 0), (0, missing)), constant_values=np.nan)
        live = is_live(slots_v)
        selected_v = np.empty((len(slots_v), self._series))
        changes = np.flatnonzero((live[1:] != live[:-1]).any(axis=1)) + 1
        for first, end in zip([0, *changes], [*changes, len(slots_v)], strict=True):
            selected_v[first:end] = self._cells(slots_v[first:end], live[first])
        return selected_v

    def _cells(self, slots_v: CellBlock, live: NDArray[np.bool_]) -> CellBlock:
        """Return the voltages of the cells of samples with the same live slots [V]."""
        count = int(live.sum())
        if count > self._series:
            self.fault = (
                f"{count} cells are measured, but the pack has {self._series} in series: correct pack.series. "
                "Until then, single cells have neither alarms nor estimates"
            )
            return np.full((len(slots_v), self._series), np.nan)
        if count == self._series:
            self._slots = np.flatnonzero(live)
        return slots_v[:, self._slots]


def is_live(slots_v: Floats) -> NDArray[np.bool_]:
    """Return True for each slot that has the voltage of a cell; NaN: False."""
    magnitude_v = np.abs(slots_v)
    return (magnitude_v >= MIN_CELL_V) & (magnitude_v <= MAX_CELL_V)
