"""Bounded history of a pack: rows of means, thinned with age."""

import numpy as np
from numpy.typing import NDArray

from bms_estimator.kernels.accumulators.history import HISTORY_ROW, ROW_SOC

MAX_ROWS = 5000
"""Maximum number of rows; older days are thinned, then dropped."""
KEPT_FRACTION = 0.8
"""Maximum number of rows after thinning, as a fraction of ``MAX_ROWS``, so that the next row does not thin the history again."""
MAX_SEGMENTS = 100
"""Maximum number of segments; older ones are dropped. Each adds about five unknowns to the fit, whose time grows with
the cube of their number: with 100 segments a fit of 30 days takes four times as long as with one."""
DAY_S = 86400.0
"""Length of a day [s]."""
MEAN_FIELDS = ("elapsed_s", "voltage_v", "current_a", "x_a", "settled_s", "temperature_c", "charge_as",
               "charge_variance_as2", "throughput_soc", "hysteresis", "soc")  # fmt: skip
"""Fields of which a merged row has the mean, weighted by duration."""


class History:
    """Rows of one pack in order of time.

    Attributes:
        rows: Shape (n,), dtype HISTORY_ROW.
    """

    def __init__(self, rows: NDArray[np.void] | None = None) -> None:
        self.rows: NDArray[np.void] = np.zeros(0, HISTORY_ROW) if rows is None else rows

    def append(self, rows: NDArray[np.void], capacity_as: float) -> None:
        """Append rows. Thin a history that is too long, and drop its oldest rows if it is still too long."""
        self.rows = newest_segments(np.concatenate([self.rows, rows]))
        if self.rows.size > MAX_ROWS:
            self.rows = thinned(self.rows, capacity_as)[-int(KEPT_FRACTION * MAX_ROWS) :]


def newest_segments(rows: NDArray[np.void]) -> NDArray[np.void]:
    """Return the rows of the last ``MAX_SEGMENTS`` segments."""
    starts = np.flatnonzero(np.diff(rows["segment"], prepend=-np.inf))
    return rows[starts[-MAX_SEGMENTS] :] if starts.size > MAX_SEGMENTS else rows


def thinned(rows: NDArray[np.void], capacity_as: float) -> NDArray[np.void]:
    """Return the rows with those older than two days merged: one row for each segment, day, SOC bin and direction."""
    is_old = (rows["elapsed_s"] < rows["elapsed_s"][-1] - 2.0 * DAY_S) & (rows["duration_s"] > 0.0)
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
    both = np.concatenate([merged(old, group.ravel()), rows[~is_old]])
    return both[np.lexsort((both["elapsed_s"], both["segment"]))]


def merged(rows: NDArray[np.void], group: NDArray[np.intp]) -> NDArray[np.void]:
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
