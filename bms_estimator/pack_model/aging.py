"""Aging of the pack: variance of the change of capacity and resistances with use and time."""

from dataclasses import dataclass

import numpy as np

from bms_estimator.model.arrays import Floats
from bms_estimator.pack_model.cell_curves import CellCurves
from bms_estimator.pack_model.intervals import DAY_S, Intervals

YEAR_S = 365.0 * DAY_S
MIN_VARIANCE = 1e-12
"""Minimum variance in the divisor of the trend. The variance over a history of one interval is 0."""


@dataclass(frozen=True)
class Aging:
    """Stds of the change of ln of a quantity by aging. Its variance is proportional to use plus time."""

    use_std: float
    """Std of the change over a charge throughput of ``CellCurves.aged_soc`` (500 full cycles)."""
    time_std: float
    """Std of the change over a year without use."""


CAPACITY = Aging(0.11, 0.05)
"""Aging of the capacity. Cells lose 5 to 20 % in 500 full cycles; the change by time is assumed."""
RESISTANCE = Aging(0.3, 0.1)
"""Aging of the resistances, which grow by two to five times the fraction of the capacity that is lost."""


class AgingVariance:
    """Variance of the change of ln of a quantity over a history.

    Args:
        aging: Aging of the quantity.
        cell: Curves of the cell file.
        intervals: Intervals of the history.

    Attributes:
        before: Variance of the change from the pack's first row, which may have been dropped, to the first row of the history.
            Use in that time is assumed to be as intense as in the history.
        at_start: Variance of the change from the first row to the start of each interval.
    """

    def __init__(self, aging: Aging, cell: CellCurves, intervals: Intervals) -> None:
        rows, starts = intervals.rows, intervals.starts
        # an interval's use lasts until the next one begins, or until its last row before a gap
        last = np.append(np.where(intervals.is_new_segment[1:], intervals.ends[:-1], starts[1:]), rows.size - 1)
        used_soc = np.maximum(rows["throughput_soc"][last] - rows["throughput_soc"][starts], 0.0)
        elapsed_s = np.append(rows["elapsed_s"][starts], rows["elapsed_s"][-1])
        steps = aging.use_std**2 * used_soc / cell.aged_soc + aging.time_std**2 * np.diff(elapsed_s) / YEAR_S
        self.at_start: Floats = np.append(0.0, np.cumsum(steps)[:-1])
        duration_s = float(elapsed_s[-1] - elapsed_s[0])
        rate = float(steps.sum()) / duration_s if duration_s > 0.0 else 0.0
        self.before = rate * float(elapsed_s[0])

    @property
    def trend(self) -> Floats:
        """Difference of ln of the quantity between the start of each interval and the last start, for a change of one std.

        The change is proportional to the variance, so that the trend rises from minus one std to 0.
        """
        relative = self.at_start - self.at_start[-1]
        return np.asarray(relative / np.sqrt(max(self.at_start[-1], MIN_VARIANCE)))
