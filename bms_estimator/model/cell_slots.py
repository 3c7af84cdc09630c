"""Selection of the cells of a pack from the cell slots that its device reports."""

from collections.abc import Sequence

import numpy as np

from bms_estimator.model.arrays import CellBlock, Floats, Masks

MIN_LIVE_V, MAX_LIVE_V = 0.1, 6.0
"""Range of the absolute voltage of a live cell [V]. Empty slots read 0 V, a few millivolts of noise, or the largest number of
their format. No single cell exceeds 5 V."""
MIN_SAMPLES = 10
"""Minimum number of samples with a wrong number of cells before ``CellSlots`` gives a reason. If a device reports its cells in
several responses, the first samples lack some of them."""


class CellSlots:
    """Cell slots of one device.

    Many devices report more slots than their pack has cells. Once a sample has as many live slots as cells in series, these
    slots are the cells, even if a cell fails later. Before that, the live slots are selected, and as many of the first other
    slots as are missing. The division of the samples into blocks does not change the selection.

    Args:
        series: Number of cells in series.
        slots: Slots of the cells. Another number than ``series`` has no effect.
        earlier: Slots of the cells in an earlier run (``cell_indices``), if the cells may have other slots now.

    Attributes:
        fault: Fault of the last block if it has more live slots than cells in series, as a sentence; empty otherwise.
        moved_reason: Reason why a cell may be missing, as a sentence, if the last block has shown the cells in other slots
            than ``earlier``; empty otherwise.
    """

    def __init__(self, series: int, slots: Sequence[int] = (), earlier: Sequence[int] = ()) -> None:
        self._series, self._is_known = series, len(slots) == series
        self._slots = np.array(slots) if self._is_known else np.arange(series)
        self._earlier = list(earlier) if len(earlier) == series else []
        self.fault = self.moved_reason = self._excess_text = ""
        self._excess_samples = 0  # number of successive samples with too many live slots
        # until enough cells are live: number of samples with live slots, and the largest number of live slots
        self._samples = self._max_cells = 0

    @property
    def cell_indices(self) -> list[int]:
        """Slots of the cells, counted from 0. They are those of the earlier run until this run has determined them."""
        return self._slots.tolist() if self._is_known else self._earlier

    @property
    def reason(self) -> str:
        """Reason why single cells have no estimates, as a sentence; empty if they have estimates, or in the first samples."""
        if self._excess_samples >= MIN_SAMPLES:
            return self._excess_text
        if self._samples < MIN_SAMPLES or self._has_enough:
            return ""
        consequence = "or measure the others. Until then, single cells have no estimates, and the others no alarms"
        return f"{self._wrong_number(self._max_cells)}, {consequence}"

    def _wrong_number(self, count: int) -> str:
        return f"{count} cells are measured, but the pack has {self._series} in series: correct pack.series"

    @property
    def _has_enough(self) -> bool:
        """True if the estimators of single cells have started, with a sample that lacks at most one cell."""
        return self._max_cells >= self._series - 1

    def select(self, cells_v: CellBlock) -> CellBlock:
        """Return the voltages of the cells [V], shape (n, m) with at most ``series`` columns.

        A sample with more live slots than cells in series has no cell voltages (NaN), because nothing shows which slots
        belong to the pack.

        Args:
            cells_v: Voltages of the slots [V], NaN if not measured, shape (n, slots).
        """
        self.fault = self.moved_reason = ""
        if not cells_v.size:
            return cells_v
        if not self._has_enough:
            counts = is_live(cells_v).sum(axis=1)
            counts[counts > self._series] = 0
            self._samples += int(np.count_nonzero(counts))
            self._max_cells = max(self._max_cells, int(counts.max()))
        if cells_v.shape[1] <= self._series and self._slots[-1] < self._series:
            self._excess_samples = 0
            return cells_v
        missing = max(int(self._slots[-1]) + 1 - cells_v.shape[1], 0)
        slots_v = np.pad(cells_v, ((0, 0), (0, missing)), constant_values=np.nan)
        live = is_live(slots_v)
        selected_v = np.empty((len(slots_v), self._series))
        changes = np.flatnonzero((live[1:] != live[:-1]).any(axis=1)) + 1
        for first, end in zip([0, *changes], [*changes, len(slots_v)], strict=True):
            selected_v[first:end] = self._cells(slots_v[first:end], live[first])
        return selected_v

    def _cells(self, slots_v: CellBlock, live: Masks) -> CellBlock:
        """Return the voltages of the cells of samples with the same live slots [V]."""
        count = int(live.sum())
        if count > self._series:
            self.fault = f"{self._wrong_number(count)}. Until then, single cells have neither alarms nor estimates"
            self._excess_samples, self._excess_text = self._excess_samples + len(slots_v), self.fault
            return np.full((len(slots_v), self._series), np.nan)
        self._excess_samples = 0
        if count == self._series and not self._is_known:  # only once: later a floating slot might replace a failed cell
            self._slots, self._is_known = np.flatnonzero(live), True
            if self._earlier and self._earlier != self.cell_indices:
                slots, earlier = (
                    ", ".join(str(slot + 1) for slot in each) for each in (self.cell_indices, self._earlier)
                )
                self.moved_reason = (
                    f"cells are measured in slots {slots}, and were in {earlier} before the restart: check their wires"
                )
        if self._is_known:
            return slots_v[:, self._slots]
        # the live slots, and the first other slots, among which may be cells with a broken wire
        order = np.argsort(~live, kind="stable")[: self._series]
        return slots_v[:, np.sort(order)]


def is_live(slots_v: Floats) -> Masks:
    """Return True for each slot that has the voltage of a cell; NaN: False."""
    magnitude_v = np.abs(slots_v)
    return (magnitude_v >= MIN_LIVE_V) & (magnitude_v <= MAX_LIVE_V)
