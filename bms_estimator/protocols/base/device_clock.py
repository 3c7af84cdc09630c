"""Sample times from a device's timestamps if they are plausible, otherwise from the arrival times."""

import math

MAX_LEAD_S = 5.0
"""Maximum time by which a sample may arrive before its timestamp [s]. A larger lead shows that the clock was set."""
MAX_CONSTANT_S = 10.0
"""Maximum time for which a timestamp may stay constant while samples arrive [s]. Then the timestamp is ignored."""
MAX_SLOWNESS = 0.01
"""Maximum relative amount by which a device's clock is slower than the host's."""
LAG_S = 60.0
"""Minimum time that a clock has lost in successive slow steps before it counts as slow [s]."""
LAG_STEPS = 3
"""Minimum number of successive slow steps before a clock counts as slow.

A step is slow if it is less than half of the elapsed time. Delayed samples do not look slow, because they arrive together.
"""


class DeviceClock:
    """Time since the first sample [s], which never decreases.

    Delayed samples arrive together, and the device's timestamps give their times. A timestamp that steps back, or leads the
    arrival, shows that the clock was set or the device restarted. Then the arrival time is used. The arrival time is also
    used after the timestamp has been constant for ``MAX_CONSTANT_S``. A slow clock would lose charge. Examples are a device
    that sleeps, and a device that sends milliseconds in place of seconds. The time that a slow clock has lost is added in
    one step, and arrival times are used from then on.

    Attributes:
        jumps: Number of rejected timestamps.
    """

    def __init__(self) -> None:
        self.jumps = 0
        self._last_s = 0.0
        self._device_s = self._arrival_s = math.nan  # last timestamp, and the arrival time at which it changed
        self._min_delay_s = math.inf
        self._lag_s, self._slow_steps, self._is_slow = 0.0, 0, False

    def sample_time(self, arrival_s: float, device_s: float) -> float:
        """Return the time of a sample since the first one [s].

        Args:
            arrival_s: Arrival time, on any clock that never steps back [s].
            device_s: Timestamp by the device's clock, with any origin [s]; NaN: not reported.
        """
        step_s, delay_s = device_s - self._device_s, arrival_s - device_s
        elapsed_s = 0.0 if math.isnan(self._arrival_s) else max(arrival_s - self._arrival_s, 0.0)
        if step_s == 0.0 and elapsed_s < MAX_CONSTANT_S:  # several samples may have the same timestamp
            return self._last_s
        if self._is_slow:
            step_s = elapsed_s
        elif step_s > 0.0 and delay_s >= self._min_delay_s - MAX_LEAD_S:
            self._min_delay_s = min(self._min_delay_s + MAX_SLOWNESS * step_s, delay_s)
            step_s += self._lost_time(step_s, elapsed_s)
        else:
            self.jumps += not math.isnan(step_s)  # a missing timestamp is no jump
            self._min_delay_s = math.inf if math.isnan(delay_s) else delay_s
            step_s = elapsed_s
        self._device_s, self._arrival_s = device_s, arrival_s
        self._last_s += step_s
        return self._last_s

    def _lost_time(self, step_s: float, elapsed_s: float) -> float:
        """Return the time that a slow clock has lost [s]; 0 if it is not slow."""
        if 2.0 * step_s >= elapsed_s:
            self._lag_s, self._slow_steps = 0.0, 0
            return 0.0
        self._lag_s, self._slow_steps = self._lag_s + elapsed_s - step_s, self._slow_steps + 1
        if self._lag_s < LAG_S or self._slow_steps < LAG_STEPS:
            return 0.0
        self._is_slow, self.jumps = True, self.jumps + 1
        return self._lag_s
