"""History of a pack with a bounded number of rows. Old rows are merged.

A segment is a time without a gap that could hide a charge. A bank is a pack of several cells in series, of which only the sum of
the voltages is evaluated. Its weak cell is found by a comparison with its first discharges (``bank_comparison``).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bms_estimator.kernels.accumulators.history import HISTORY_ROW, ROW_SOC
from bms_estimator.pack_model.fit import PackFit

MAX_ROWS = 5000
"""Maximum number of rows."""
KEPT_FRACTION = 0.8
"""Maximum number of rows after merging, as a fraction of ``MAX_ROWS``. Without this reserve each new row would begin another
merge."""
MAX_SEGMENTS = 100
"""Maximum number of segments. Each adds about five unknowns to the fit, whose time grows with the cube of their number: with 100
segments a fit of 30 days takes four times as long as with one."""
RECENT_SEGMENTS = MAX_SEGMENTS // 2
"""Number of the latest segments that are kept even without a known SOC. Of earlier segments, those with a known SOC are
preferred."""
DAY_S = 86400.0
MEAN_FIELDS = ("elapsed_s", "voltage_v", "current_a", "between_a2", "skew_a2", "x_a", "settled_s", "temperature_c", "charge_as",
               "charge_variance_as2", "throughput_soc", "hysteresis", "soc")  # fmt: skip
"""Fields of ``HISTORY_ROW`` that a merged row averages, weighted by duration."""
OLD_S = 2.0 * DAY_S
"""Minimum age of merged rows [s]."""


class WeakCellTime(NamedTuple):
    """Time in which a cell of the bank was weak. Its discharges are no reference."""

    start_s: float
    """Time of the first row of the discharge that found the weak cell [s]."""
    end_s: float
    """Start of the first later discharge in which no weak cell was found [s]; infinite while the cell is weak."""
    soc: float
    """SOC at which the last discharge found it."""


@dataclass(frozen=True)
class ReferenceDischarges:
    """Rows of the first discharges of a bank, and the fit that was made after them."""

    rows: NDArray[np.void]
    """Shape (n,), dtype HISTORY_ROW. Their field ``soc`` is the fitted SOC."""
    fit: PackFit


class History:
    """Rows of one pack in order of time.

    Attributes:
        rows: Shape (n,), dtype HISTORY_ROW.
        weak_cell_times: Times in which a cell of the bank was weak.
        first_discharges: First discharges of the bank; None: too few rows, or no bank. They do not change, so that a slowly
            weakening cell deviates from them.
    """

    def __init__(
        self,
        rows: NDArray[np.void] | None = None,
        weak_cell_times: Sequence[WeakCellTime] = (),
        first_discharges: ReferenceDischarges | None = None,
    ) -> None:
        self.rows: NDArray[np.void] = np.zeros(0, HISTORY_ROW) if rows is None else rows
        self.weak_cell_times = list(weak_cell_times)
        self.first_discharges = first_discharges

    def append(self, rows: NDArray[np.void], capacity_as: float) -> None:
        """Append rows. If there are too many, merge old rows, and drop the oldest if there are still too many."""
        first_new = float(rows["segment"][0]) if rows.size else np.inf
        self.rows = bounded_segments(np.concatenate([self.rows, rows]), first_new, capacity_as)
        if self.rows.size > MAX_ROWS:
            self.rows = thin_old_rows(self.rows, capacity_as)[-int(KEPT_FRACTION * MAX_ROWS) :]


def bounded_segments(rows: NDArray[np.void], first_new: float, capacity_as: float) -> NDArray[np.void]:
    """Return the rows of the ``MAX_SEGMENTS`` segments with the most information.

    Segments that neither change nor determine the SOC are dropped first. Then older ones without a known SOC are dropped, because
    known SOCs determine capacity and offset over a long time. Within each group the oldest are dropped first. The charge of a
    dropped segment is added to the gap before the next one.

    Args:
        rows: Shape (n,), dtype HISTORY_ROW, in order of time.
        first_new: Number of the first segment that is never dropped.
        capacity_as: Declared capacity [A s].
    """
    starts = np.flatnonzero(np.diff(rows["segment"], prepend=-np.inf))
    excess = starts.size - MAX_SEGMENTS
    if excess <= 0:
        return rows
    charge_as = rows["charge_as"]
    moved_as = np.maximum.reduceat(charge_as, starts) - np.minimum.reduceat(charge_as, starts)
    is_known = np.logical_or.reduceat(np.isfinite(rows["reference_soc"]), starts)
    is_recent = np.arange(starts.size) >= starts.size - RECENT_SEGMENTS
    priority = np.where(is_known | is_recent, 2, 1)
    priority[~is_known & (moved_as < ROW_SOC * capacity_as)] = 0
    priority[rows["segment"][starts] >= first_new] = 3
    is_dropped = np.zeros(starts.size, bool)
    is_dropped[np.argsort(priority, kind="stable")[:excess]] = True
    return _without_segments(rows, np.append(starts, rows.size), is_dropped)


def _without_segments(
    rows: NDArray[np.void], bounds: NDArray[np.intp], is_dropped: NDArray[np.bool_]
) -> NDArray[np.void]:
    """Return the rows without some segments, of which segment k has the rows from ``bounds[k]`` to ``bounds[k + 1]``."""
    rows, sizes = rows.copy(), np.diff(bounds)
    for k in np.flatnonzero(is_dropped[:-1]).tolist():
        first, last, after = rows[bounds[k]], rows[bounds[k + 1] - 1], rows[bounds[k + 1] : bounds[k + 2]]
        # the charge counter of a segment starts at the end of the previous segment
        after["charge_as"] += last["charge_as"]
        after["charge_variance_as2"] += last["charge_variance_as2"]
        after["gap_s"] += last["gap_s"] + last["elapsed_s"] - first["elapsed_s"]
    kept: NDArray[np.void] = rows[~np.repeat(is_dropped, sizes)]
    return kept


def thin_old_rows(rows: NDArray[np.void], capacity_as: float) -> NDArray[np.void]:
    """Return rows in which those older than ``OLD_S`` are merged to one for each segment, day, SOC bin and direction."""
    # a row of duration 0 has only a known SOC and is not merged
    is_old = (rows["elapsed_s"] < rows["elapsed_s"][-1] - OLD_S) & (rows["duration_s"] > 0.0)
    old = rows[is_old]
    if old.size == 0:
        return rows
    key = np.column_stack(
        [
            old["segment"],
            np.floor(old["elapsed_s"] / DAY_S),
            np.floor(old["charge_as"] / (ROW_SOC * capacity_as)),
            old["direction"],
        ]
    )
    _, group = np.unique(key, axis=0, return_inverse=True)
    result = np.concatenate([merge_groups(old, group.ravel()), rows[~is_old]])
    ordered: NDArray[np.void] = result[np.lexsort((result["elapsed_s"], result["segment"]))]
    return ordered


def merge_groups(rows: NDArray[np.void], group: NDArray[np.intp]) -> NDArray[np.void]:
    """Return one row for each group, with the sum of durations and the means weighted by duration.

    Args:
        rows: Rows with a voltage.
        group: Group of each row, 0, 1, ... Fields without a mean are those of the group's first row.
    """
    _, first = np.unique(group, return_index=True)
    result, duration_s = rows[first], rows["duration_s"]
    result["duration_s"] = np.bincount(group, duration_s)
    for name in MEAN_FIELDS:
        sums = np.zeros(result[name].shape)
        np.add.at(sums, group, (rows[name].T * duration_s).T)
        result[name] = (sums.T / result["duration_s"]).T
    return result
