"""Intervals of the history: each has its own SOC at its start, offset and capacity, and lies within one segment."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bms_estimator.kernels.accumulators.history import ROW_SOC
from bms_estimator.model.arrays import Floats
from bms_estimator.pack_model.cell_curves import CellCurves

DAY_S = 86400.0
INTERVAL_S = DAY_S
"""Maximum duration of an interval [s]."""
COUNTED_STD = 0.015
"""Std of the charge counted in an interval, as a fraction of the capacity, at which the interval ends. A sensor with a dead
band reports no current at night, so that the charge counted in a day may be wrong by several percent."""
MAX_INTERVALS = 200
"""Maximum number of intervals, unless there are more segments. Each interval adds three unknowns."""
HOUR_S = 3600.0
DAILY_STD_SOC = 0.002
"""Std of the SOC counted over a day without throughput, due to charge that is not counted at rest, such as self-discharge.
Assumed."""


class Intervals:
    """Division of a history into intervals.

    Args:
        cell: Curves of the cell file.
        rows: Shape (n,), dtype HISTORY_ROW, in order of time.

    Attributes:
        starts, ends: First and last row of each interval.
        of_row: Interval of each row.
        is_new_segment: True for each interval that begins a segment.
        segment: Segment of each row, counted from 0.
        drawn_soc: Charge drawn since the interval's first row, as a fraction of the declared capacity, for each row.
        hours: Time since the interval's first row [h], for each row.
    """

    def __init__(self, cell: CellCurves, rows: NDArray[np.void]) -> None:
        self.rows = rows
        self.starts, self.of_row = bounded_split(rows, COUNTED_STD * cell.capacity_as)
        self.ends = np.r_[self.starts[1:], rows.size] - 1
        start = rows[self.starts]
        self.is_new_segment = np.r_[True, start["segment"][1:] != start["segment"][:-1]]
        self.segment = (np.cumsum(self.is_new_segment) - 1)[self.of_row]
        self.drawn_soc: Floats = (rows["charge_as"] - start["charge_as"][self.of_row]) / cell.capacity_as
        self.hours: Floats = (rows["elapsed_s"] - start["elapsed_s"][self.of_row]) / HOUR_S

    def rows_of_pass(self) -> NDArray[np.intp]:
        """Return, for each row, the number of rows of its pass and direction, itself included.

        A pass is a time in which the charge stays in one bin of ``ROW_SOC``. The errors of its rows are nearly equal. A small
        current that changes between rest and load divides a pass into many rows.
        """
        charge_bin = np.floor(self.drawn_soc / ROW_SOC)
        number = np.cumsum(np.diff(charge_bin, prepend=charge_bin[:1]) != 0.0)
        key = np.column_stack([self.of_row, number, self.rows["direction"], self.rows["duration_s"] > 0.0])
        _, group, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
        return np.asarray(count[group.ravel()])

    @property
    def count(self) -> int:
        """Number of intervals."""
        return int(self.starts.size)

    @property
    def segments(self) -> int:
        """Number of segments."""
        return int(self.is_new_segment.sum())


def bounded_split(rows: NDArray[np.void], max_std_as: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the first row of each interval, and the interval of each row.

    The limits of duration and std are doubled until there are at most ``MAX_INTERVALS``, or until each segment is one
    interval.
    """
    segments, scale = np.unique(rows["segment"]).size, 1.0
    starts, of_row = split(rows, INTERVAL_S, max_std_as**2)
    while starts.size > max(MAX_INTERVALS, segments):
        scale *= 2.0
        starts, of_row = split(rows, scale * INTERVAL_S, (scale * max_std_as) ** 2)
    return starts, of_row


def split(rows: NDArray[np.void], max_s: float, max_variance_as2: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the first row of each interval, and the interval of each row, for limits of duration and variance."""
    segment, elapsed_s = rows["segment"].tolist(), rows["elapsed_s"].tolist()
    variance_as2 = rows["charge_variance_as2"].tolist()
    starts, of_row = [0], np.zeros(rows.size, np.intp)
    for j in range(1, rows.size):
        first = starts[-1]
        is_long = elapsed_s[j] - elapsed_s[first] > max_s
        if segment[j] != segment[j - 1] or is_long or variance_as2[j] - variance_as2[first] > max_variance_as2:
            starts.append(j)
        of_row[j] = len(starts) - 1
    return np.array(starts, np.intp), of_row


@dataclass(frozen=True)
class Links:
    """Charge from the start of one interval to the start of the next. A gap of unknown duration has no link."""

    interval: NDArray[np.intp]
    """Later interval of each link."""
    drawn_soc: Floats
    """Charge between the two starts, as a fraction of the declared capacity."""
    hours: Floats
    """Measured time between the two starts, in which the sensor's offset was counted as charge [h]."""
    std: Floats
    """Std of the SOC at the later start, counted from the earlier one."""
    event_probability: Floats
    """Probability that the gap between the two intervals hides a charge; 0 without a gap."""

    @classmethod
    def of(cls, cell: CellCurves, intervals: Intervals) -> "Links":
        """Return the links of a history."""
        rows, starts, is_new = intervals.rows, intervals.starts, intervals.is_new_segment
        k = np.flatnonzero(np.isfinite(rows["gap_s"][starts]) | ~is_new)
        k = k[k > 0]
        is_gap = is_new[k]
        first, before, after = rows[starts[k - 1]], rows[starts[k] - 1], rows[starts[k]]

        def increase_between_rows(name: str) -> Floats:
            """Return the increase of a counter from the earlier interval's last row to the later interval's first row.

            In a new segment the counter begins at 0 before the gap, so that its value is the increase.
            """
            return np.asarray(after[name] - np.where(is_gap, 0.0, before[name]))

        def increase(name: str) -> Floats:
            """Return the increase of a counter from start to start."""
            return np.asarray(before[name] - first[name] + increase_between_rows(name))

        throughput_soc = increase("throughput_soc")
        variance_as2 = np.maximum(increase("charge_variance_as2"), 0.0)
        between_s = np.where(is_gap, 0.0, after["elapsed_s"] - before["elapsed_s"])
        days = np.maximum(after["elapsed_s"] - first["elapsed_s"], HOUR_S) / DAY_S
        return cls(
            interval=k,
            drawn_soc=intervals.drawn_soc[starts[k] - 1] + increase_between_rows("charge_as") / cell.capacity_as,
            hours=intervals.hours[starts[k] - 1] + between_s / HOUR_S,
            std=np.sqrt(
                cell.charge_error**2 * throughput_soc + DAILY_STD_SOC**2 * days + variance_as2 / cell.capacity_as**2
            ),
            event_probability=np.where(is_gap, cell.event_probability * -np.expm1(-after["gap_s"] / cell.event_s), 0.0),
        )
