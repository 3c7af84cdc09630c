"""Timestamps that a device sends with its values, if they are plausible; else those of the arrivals."""

import math

EARLY_S = 5.0
"""Maximum time by which a sample may precede its own timestamp [s]; more shows that the clock was set."""
STUCK_S = 10.0
"""Duration for which a device time may stay constant while samples arrive; after it the device time is ignored
[s]."""
SLOWEST = 0.01
"""No device's clock is slower than the host's by more than this, relative."""
LAG_S, LAG_STEPS = 60.0, 3
"""Lag [s] and number of successive slow steps, each below half of the elapsed time, after which a clock counts as
slow. Samples that merely waited would arrive together."""


class DeviceClock:
    """Time since the first sample [s], which never decreases.

    Delayed samples arrive together, and their own timestamps place them. A timestamp that steps back, or lies ahead of its
    arrival, shows that the clock was set or the device restarted: then the arrival counts. The arrival also counts
    while the clock stands still. A slow clock, as of a sleeping device or one that sends milliseconds in place of
    seconds, would lose
    charge. Its lost time is added in one step, and arrivals count from then on.

    Attributes:
        jumps: Number of rejected times.
    """

    def __init__(self) -> None:
        self.jumps = 0
        self._last_s = 0.0
        self._told_s = self._arrival_s = math.nan  # the latter when the device's time last changed
        self._least_late_s = math.inf
        self._lag_s, self._lags, self._slow = 0.0, 0, False

    def sample_time(self, arrival_s: float, told_s: float) -> float:
        """Time of a sample [s].

        Args:
            arrival_s: Arrival time, on any clock that never steps back [s].
            told_s: Time of measurement by the device's clock, with any origin [s]; NaN: not reported.
        """
        step_s, late_s = told_s - self._told_s, arrival_s - told_s
        passed_s = 0.0 if math.isnan(self._arrival_s) else max(arrival_s - self._arrival_s, 0.0)
        if step_s == 0.0 and passed_s < STUCK_S:
            return self._last_s
        if self._slow:
            step_s = passed_s
        elif step_s > 0.0 and late_s >= self._least_late_s - EARLY_S:
            self._least_late_s = min(self._least_late_s + SLOWEST * step_s, late_s)
            step_s += self._lost(step_s, passed_s)
        else:
            self.jumps += not math.isnan(step_s)
            self._least_late_s = math.inf if math.isnan(late_s) else late_s
            step_s = passed_s
        self._told_s, self._arrival_s = told_s, arrival_s
        self._last_s += step_s
        return self._last_s

    def _lost(self, step_s: float, passed_s: float) -> float:
        """Return the time that a slow clock has lost [s]; else 0."""
        if 2.0 * step_s >= passed_s:
            self._lag_s, self._lags = 0.0, 0
            return 0.0
        self._lag_s, self._lags = self._lag_s + passed_s - step_s, self._lags + 1
        if self._lag_s < LAG_S or self._lags < LAG_STEPS:
            return 0.0
        self._slow, self.jumps = True, self.jumps + 1
        return self._lag_s
