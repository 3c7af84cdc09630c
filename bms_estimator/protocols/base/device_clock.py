"""Sample times from a device's timestamps if they are plausible, otherwise from the arrival times."""

import math

from bms_estimator.protocols.base.clock_rate import ClockRate, Point

MAX_LEAD_S = 5.0
"""Maximum time by which a sample may arrive before its time [s]. A larger lead shows that the clock was set."""
MAX_CONSTANT_S = 10.0
"""Maximum time for which a timestamp may stay constant while samples arrive [s]. Then the timestamp is ignored."""
MAX_SLOWNESS = 0.01
"""Maximum relative amount by which a device's clock is slower than the host's."""
START_S = 1.0
"""Maximum duration of a backlog that is being sent at the first sample [s]. Its samples keep their own times."""


class DeviceClock:
    """Time since the first sample [s], which never decreases.

    Delayed samples arrive together, and the device's timestamps give their times. A timestamp that steps back, or leads the
    arrival, shows that the clock was set or the device restarted. Then the arrival time is used. The arrival time is also
    used after the timestamp has been constant for ``MAX_CONSTANT_S``, and while the clock is wrong. A slow clock
    would lose charge and stretch the delays of alarms. Examples are a device that sleeps, and a device that sends
    milliseconds in place of seconds. The time that a slow clock has lost is added in one step.

    The time leads the arrivals by at most ``MAX_LEAD_S``, whatever timestamps a device sends. Therefore no delay of an alarm
    ends much too early. The delay of a sample is its arrival minus its time here, which does not change if the clock is set.
    After ``START_S`` the least delay never decreases, so that the leads of several timestamps do not add up.

    Attributes:
        jumps: Number of rejected timestamps.
    """

    def __init__(self) -> None:
        self.jumps = 0
        self._last_s = 0.0
        self._device_s = self._arrival_s = math.nan  # last timestamp, and the arrival time at which it changed
        self._first_s = self._min_delay_s = math.nan  # first arrival time, and the least delay
        self._rate = ClockRate()

    @property
    def fault(self) -> str:
        """Description of a wrong clock; empty while the clock is usable."""
        return self._rate.fault

    def sample_time(self, arrival_s: float, device_s: float) -> float:
        """Return the time of a sample since the first one [s].

        Args:
            arrival_s: Arrival time, on any clock that never steps back [s].
            device_s: Timestamp by the device's clock, with any origin [s]; NaN: not reported.
        """
        if math.isnan(self._arrival_s):
            self._arrival_s = self._first_s = self._min_delay_s = arrival_s
        wrong_since = self._rate.check(arrival_s)
        self._advance(arrival_s, device_s, wrong_since)
        if math.isfinite(device_s):
            self._rate.add(Point(arrival_s, device_s, self._last_s))
        return self._last_s

    def _advance(self, arrival_s: float, device_s: float, wrong_since: Point | None) -> None:
        """Advance ``_last_s``. If a wrong clock was just detected, ``wrong_since`` is the first point with wrong times."""
        step_s, elapsed_s = device_s - self._device_s, max(arrival_s - self._arrival_s, 0.0)
        if step_s == 0.0 and elapsed_s < MAX_CONSTANT_S and not self._rate.fault:  # several may share one timestamp
            return
        leads = arrival_s - (self._last_s + step_s) < self._min_delay_s - MAX_LEAD_S
        if step_s <= 0.0 or (leads and step_s > elapsed_s + MAX_LEAD_S):  # otherwise the lead has grown slowly
            self.jumps += not self._rate.fault
            self._rate.on_jump(abs(step_s - elapsed_s))
        if wrong_since:
            self.jumps += 1
            step_s = max(arrival_s - wrong_since.arrival_s - (self._last_s - wrong_since.time_s), 0.0)
        elif leads or self._rate.fault or not step_s > 0.0:  # NaN is a missing timestamp
            step_s = elapsed_s
        self._device_s, self._arrival_s = device_s, arrival_s
        self._last_s += step_s
        delay_s = arrival_s - self._last_s
        if not self.jumps and arrival_s - self._first_s <= START_S:
            self._min_delay_s = min(self._min_delay_s, delay_s)
        else:
            increased_s = self._min_delay_s + MAX_SLOWNESS * min(step_s, elapsed_s)
            self._min_delay_s = min(increased_s, max(self._min_delay_s, delay_s))
