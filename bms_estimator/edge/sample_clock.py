"""Clock that dates the samples of an edge."""

import math

import numpy as np

from bms_estimator.model.arrays import Floats

DEAD_BAND_S = 1.0
"""Maximum difference between the source's clock and the host's that is not corrected [s], because transport delays vary
too."""
STEP_S = 10.0
"""Minimum difference between the clocks that counts as a step and not as drift [s]. The skipped time becomes a gap."""
SLEW = 0.01
"""Relative rate at which a difference between ``DEAD_BAND_S`` and ``STEP_S`` is corrected. It exceeds the drift of any
resonator."""
WINDOW_S = 600.0
"""Window over which the smallest delay is taken [s]. Samples arrive late and never early, so the smallest delay is the
lag of the source's clock."""
GRID = 2.0**20
"""Clock offsets are multiples of ``1 / GRID`` seconds. With these offsets, a constant sample period stays constant to
the last bit, which compresses best."""


class SampleClock:
    """Clock in seconds since 1970 that never decreases, even if the wall clock does.

    The source's clock gives the intervals between samples. The host's wall clock gives the start, and the host's
    steady clock gives the corrections. The clock follows a wall clock that is set ahead, as on a machine that boots
    without the time; the step becomes a gap. The clock ignores a wall clock that is set back.

    Args:
        last_s: Time of the last sample of an earlier run [s since 1970]; minus infinity without an earlier run.

    Attributes:
        steps: Number of times that a clock was set or the source started.
    """

    def __init__(self, last_s: float = -math.inf) -> None:
        self.steps = 0
        self._last_s = last_s
        self._lead_s = math.nan  # this clock minus the host's steady clock
        self._source_s = math.nan  # the source's clock at the last sample
        self._offset_s = 0.0  # this clock minus the source's
        self._slew_s = 0.0  # remaining correction of the offset, applied at the rate SLEW
        self._min_delay_s, self._window_s = math.inf, 0.0  # smallest delay in the window, and start of the window

    def advance_to(self, time_s: float) -> None:
        """Place the next sample at ``time_s`` if that is later than all placed samples [s since 1970]."""
        if time_s > self._last_s:
            self._last_s, self._lead_s, self._source_s = time_s, math.nan, math.nan

    def place(self, source_s: Floats, wall_s: float, steady_s: float) -> Floats:
        """Return timestamps of samples that have just arrived [s since 1970].

        Args:
            source_s: Times of the source's clock [s], shape (n,). A non-finite time is replaced by the previous one.
            wall_s: Wall clock now [s since 1970].
            steady_s: Monotonic clock that continues during suspend [s].
        """
        now_s = self._now(wall_s, steady_s)
        source_s = _fill_non_finite(source_s, self._source_s)
        runs = np.split(source_s, np.flatnonzero(np.diff(source_s) < 0.0) + 1)
        return np.concatenate([self._place(run, now_s) for run in runs if run.size] or [source_s])

    def _now(self, wall_s: float, steady_s: float) -> float:
        """Return this clock's present time [s since 1970]."""
        if math.isnan(self._lead_s):
            self._lead_s = max(wall_s, self._last_s) - steady_s
        elif wall_s - steady_s > self._lead_s + STEP_S:
            self._lead_s = wall_s - steady_s
            self._source_s = math.nan
        return steady_s + self._lead_s

    def _place(self, source_s: Floats, now_s: float) -> Floats:
        """Return timestamps of samples between which the source's clock does not step back."""
        delay_s = now_s - (float(source_s[-1]) + self._offset_s)
        # the first comparison is also false for the first samples, when _source_s is NaN
        if not source_s[0] >= self._source_s or delay_s < -STEP_S:
            self._reset_mapping(source_s, now_s)
        else:
            self._update_drift(delay_s, now_s)
        placed = source_s + self._offset_s
        span_s = float(source_s[-1]) - self._source_s
        if self._slew_s and span_s > 0.0:  # spread the correction evenly over the samples
            shift_s = min(max(self._slew_s, -SLEW * span_s), SLEW * span_s)
            placed += shift_s * (source_s - self._source_s) / span_s
            self._offset_s += shift_s
            self._slew_s -= shift_s
        placed = np.maximum(placed, self._last_s)
        self._source_s, self._last_s = float(source_s[-1]), float(placed[-1])
        return placed

    def _reset_mapping(self, source_s: Floats, now_s: float) -> None:
        """Map the last sample to now, unless the first one would then precede an earlier sample."""
        offset_s = max(now_s - float(source_s[-1]), self._last_s - float(source_s[0]))
        self._offset_s, self._slew_s = math.ceil(offset_s * GRID) / GRID, 0.0
        self._source_s = float(source_s[0])
        self._min_delay_s, self._window_s = math.inf, now_s
        self.steps += 1

    def _update_drift(self, delay_s: float, now_s: float) -> None:
        """Schedule a correction if the source's clock runs ahead or falls behind."""
        if delay_s < -DEAD_BAND_S:  # one sample from the future is proof, because transport only delays
            self._slew_s = delay_s
        self._min_delay_s = min(self._min_delay_s, delay_s)
        if now_s - self._window_s < WINDOW_S:
            return
        behind_s, self._min_delay_s, self._window_s = self._min_delay_s, math.inf, now_s
        if behind_s > STEP_S:
            self._offset_s += math.floor(behind_s * GRID) / GRID
            self._slew_s = 0.0
            self.steps += 1
        elif behind_s > DEAD_BAND_S:
            self._slew_s = behind_s


def _fill_non_finite(source_s: Floats, previous_s: float) -> Floats:
    """Replace each non-finite time by the previous time, or by 0 at the start."""
    if np.isfinite(source_s).all():
        return source_s
    filled = source_s.copy()
    for i in np.flatnonzero(~np.isfinite(source_s)):
        filled[i] = filled[i - 1] if i else (previous_s if math.isfinite(previous_s) else 0.0)
    return filled
