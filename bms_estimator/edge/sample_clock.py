"""The time of samples on their way to a fleet: a source's clock mapped onto one that never steps back. Pure."""

import math

import numpy as np
from numpy.typing import NDArray

Times = NDArray[np.float64]

BAND_S = 1.0
"""Maximum difference between a source's clock and the host's that is not corrected [s]: transport delays vary, too."""
STEP_S = 10.0
"""Difference of a source's clock beyond which it was set; the skipped time is a gap [s]."""
SLEW = 0.01
"""Relative rate at which an offset of a source's clock below that is corrected: no resonator is as wrong."""
WINDOW_S = 600.0
"""Window of the smallest delay [s]: samples are late and never early, so the smallest delay shows a clock's lag."""
GRID = 2.0**20
"""Offsets are multiples of 1/GRID, so that a constant period stays constant, which compresses best."""


class SampleClock:
    """Seconds since 1970 that never decrease, even if the wall clock does.

    Between samples counts the source's clock. The host gives its start by the wall clock, and its corrections by the
    monotonic clock. A wall clock that is set ahead is followed, as on a machine that starts without the time; the
    step is a gap. One that is set back is not.

    Args:
        last_s: Time of the last sample that was placed, in an earlier run, too [s since 1970]; none: minus infinity.

    Attributes:
        steps: Number of times that a clock was set, or the source restarted.
    """

    def __init__(self, last_s: float = -math.inf) -> None:
        self.steps = 0
        self._last_s = last_s
        self._lead_s = math.nan  # our clock less the host's steady one
        self._told_s = math.nan  # the source's clock at the last sample
        self._offset_s = 0.0  # our clock less the source's
        self._slew_s = 0.0  # slow increase of the offset
        self._least_late_s, self._window_s = math.inf, 0.0  # of the present window, and when it began

    def go_on_from(self, time_s: float) -> None:
        """Place nothing before a time later than all placed samples, and the next sample there [s since 1970]."""
        if time_s > self._last_s:
            self._last_s, self._lead_s, self._told_s = time_s, math.nan, math.nan

    def place(self, told_s: Times, wall_s: float, steady_s: float) -> Times:
        """Return timestamps of samples that have just arrived [s since 1970].

        Args:
            told_s: Times on the source's clock [s], shape (n,); a non-finite time counts as that of the previous sample.
            wall_s: Wall clock now [s since 1970].
            steady_s: A clock that never steps and continues during suspend [s].
        """
        now_s = self._now(wall_s, steady_s)
        told_s = _finite(told_s, self._told_s)
        runs = np.split(told_s, np.flatnonzero(np.diff(told_s) < 0.0) + 1)
        return np.concatenate([self._place(run, now_s) for run in runs if run.size] or [told_s])

    def _now(self, wall_s: float, steady_s: float) -> float:
        """Our clock now [s]."""
        if math.isnan(self._lead_s):
            self._lead_s = max(wall_s, self._last_s) - steady_s
        elif wall_s - steady_s > self._lead_s + STEP_S:
            self._lead_s = wall_s - steady_s
            self._told_s = math.nan
        return steady_s + self._lead_s

    def _place(self, told_s: Times, now_s: float) -> Times:
        """Return timestamps of samples during which the source's clock does not step back."""
        late_s = now_s - (float(told_s[-1]) + self._offset_s)
        if not told_s[0] >= self._told_s or late_s < -STEP_S:  # of a first one, too
            self._map_anew(told_s, now_s)
        else:
            self._watch(late_s, now_s)
        placed = told_s + self._offset_s
        span_s = float(told_s[-1]) - self._told_s
        if self._slew_s and span_s > 0.0:
            shift_s = min(max(self._slew_s, -SLEW * span_s), SLEW * span_s)
            placed += shift_s * (told_s - self._told_s) / span_s
            self._offset_s += shift_s
            self._slew_s -= shift_s
        placed = np.maximum(placed, self._last_s)
        self._told_s, self._last_s = float(told_s[-1]), float(placed[-1])
        return placed

    def _map_anew(self, told_s: Times, now_s: float) -> None:
        """Map the last sample to now, unless the first one would then precede an earlier sample."""
        offset_s = max(now_s - float(told_s[-1]), self._last_s - float(told_s[0]))
        self._offset_s, self._slew_s = math.ceil(offset_s * GRID) / GRID, 0.0
        self._told_s = float(told_s[0])
        self._least_late_s, self._window_s = math.inf, now_s
        self.steps += 1

    def _watch(self, late_s: float, now_s: float) -> None:
        """Find out whether the source's clock runs ahead, or falls behind."""
        if late_s < -BAND_S:
            self._slew_s = late_s
        self._least_late_s = min(self._least_late_s, late_s)
        if now_s - self._window_s < WINDOW_S:
            return
        behind_s, self._least_late_s, self._window_s = self._least_late_s, math.inf, now_s
        if behind_s > STEP_S:
            self._offset_s += math.floor(behind_s * GRID) / GRID
            self._slew_s = 0.0
            self.steps += 1
        elif behind_s > BAND_S:
            self._slew_s = behind_s


def _finite(told_s: Times, before_s: float) -> Times:
    """Each that is not finite as the one before it."""
    if np.isfinite(told_s).all():
        return told_s
    filled = told_s.copy()
    for i in np.flatnonzero(~np.isfinite(told_s)):
        filled[i] = filled[i - 1] if i else before_s if math.isfinite(before_s) else 0.0
    return filled
