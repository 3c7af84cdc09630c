"""Sample times from a device's timestamps if they are plausible, otherwise from the arrival times.

Timestamps are implausible if the device's clock has a wrong rate, or jumps repeatedly, compared with the arrival times.
"""

import itertools
import math
from collections import deque
from typing import NamedTuple

WINDOW_S = 10.0
"""Minimum length of a window of arrivals [s]. Three windows, 30 s, show a wrong rate."""
MAX_POINTS = 13
"""Maximum number of windows that are compared: two minutes."""
MAX_RATE_ERROR = 0.05
"""Maximum relative rate error of a usable clock. The delays of the alarms are then wrong by at most 5 %."""
MIN_DRIFT_S = 2.0
"""Minimum drift of a wrong clock beyond its largest step [s]. Changes of a network's delay are smaller."""
MAX_SPACING_RATIO = 2.5
"""Maximum ratio of two successive intervals between windows. A larger one shows an outage."""
RECOVERY_STEPS = 3
"""Number of successive windows without drift and large jumps after which a clock is usable again."""
MAX_JUMP_RATE = 0.8
"""Maximum sum of the jumps in a window, relative to its duration. Three successive windows above it show a wrong clock. Setting a
clock changes one window. Samples at 1 Hz that overtake each other by up to 3 s reach 0.7 in one of three windows."""
_JUMPS_TEXT = (
    "the times of the source jump again and again, and the arrival times are used instead; let only one device send, "
    "correct its clock, or do not send its times"
)
_UNITS = {
    1e3: "milliseconds read as seconds",
    1e6: "microseconds read as seconds",
    1e9: "nanoseconds read as seconds",
    1e-3: "seconds read as milliseconds",
}
"""Wrong unit by rate."""
UNIT_TOLERANCE = 0.3
"""Relative tolerance of a rate that shows a wrong unit."""


class Point(NamedTuple):
    """Sample with the least delay of a window, all times in seconds."""

    arrival_s: float
    device_s: float
    """Timestamp by the device's clock."""
    time_s: float
    """Time that was assigned to the sample."""

    @property
    def delay_s(self) -> float:
        """Arrival time minus timestamp, which has any origin."""
        return self.arrival_s - self.device_s


class ClockRate:
    """Rate of a device's clock, from the least delayed sample of each window, and its jumps.

    Jitter and bursts do not change the least delay. A clock that was set changes it once. After an outage, a publisher that
    sends its backlog seems to have a fast clock, but its delay does not fall below the least one before the outage. Only a
    backlog that is being sent at the first sample looks like a fast clock, until all of it is sent.

    Attributes:
        fault: Description of a wrong rate or of repeated jumps; empty while the clock is usable.
    """

    def __init__(self) -> None:
        self.fault = ""
        self._points: deque[Point] = deque(maxlen=MAX_POINTS)  # least delayed samples of successive windows
        self._floor_s = float("inf")  # least delay before ``_points``
        self._least_delayed: Point | None = None  # least delayed sample of the present window
        self._begin_s = self._spacing_s = 0.0
        self._jumps_s = 0.0  # sum of the jumps in the present window
        self._jumping: deque[bool] = deque(maxlen=RECOVERY_STEPS)  # True for each window with large jumps

    def add(self, point: Point) -> None:
        """Add a sample to the present window."""
        if self._least_delayed is None:
            self._begin_s = point.arrival_s
        if self._least_delayed is None or point.delay_s <= self._least_delayed.delay_s:
            self._least_delayed = point

    def on_jump(self, size_s: float) -> None:
        """Add a jump to the present window [s]. Forget the least delay, because the device's clock was set."""
        self._floor_s = float("inf")
        self._jumps_s += size_s

    def check(self, arrival_s: float) -> Point | None:
        """Close the present window if it is complete at ``arrival_s`` [s].

        Returns:
            First point with wrong times if a wrong clock is detected now; otherwise None.
        """
        if self._least_delayed is None or arrival_s - self._begin_s < WINDOW_S:
            return None
        point, self._least_delayed = self._least_delayed, None
        self._jumping.append(self._jumps_s >= MAX_JUMP_RATE * (arrival_s - self._begin_s))
        self._jumps_s = 0.0
        if self._points and self._is_outage(point):
            self._restart(point)
        else:
            self._points.append(point)
        if _has_reversed(self._steps_s()):
            self._restart(point)
        steps_s = self._steps_s()
        if self.fault:
            recent = steps_s[-RECOVERY_STEPS:]
            self.fault = self.fault if len(recent) < RECOVERY_STEPS or any(recent) or any(self._jumping) else ""
        elif self._is_wrong(steps_s):
            first = self._points[0]
            self.fault = _rate_fault((point.device_s - first.device_s) / (point.arrival_s - first.arrival_s))
            return first
        elif len(self._jumping) == RECOVERY_STEPS and all(self._jumping):
            self.fault = _JUMPS_TEXT
            return self._points[0]
        return None

    def _steps_s(self) -> list[float]:
        """Return the drifts between successive windows [s]."""
        return [_drift_s(a, b) for a, b in itertools.pairwise(self._points)]

    def _is_outage(self, point: Point) -> bool:
        """Return True if there was an outage before the window of ``point``."""
        before_s, self._spacing_s = self._spacing_s, point.arrival_s - self._points[-1].arrival_s
        return self._spacing_s > MAX_SPACING_RATIO * max(before_s, WINDOW_S)

    def _restart(self, point: Point) -> None:
        """Restart the comparison of windows with that of ``point``."""
        self._floor_s = min(self._floor_s, *(each.delay_s for each in self._points))
        self._points.clear()
        self._points.append(point)

    def _is_wrong(self, steps_s: list[float]) -> bool:
        """Return True if the delay grows, or falls below all earlier ones, in more than one step."""
        if len(steps_s) < 2 or not steps_s[-1]:
            return False
        is_below_floor = self._points[-1].delay_s < self._floor_s - MIN_DRIFT_S
        beyond_largest_s = abs(sum(steps_s)) - max(map(abs, steps_s))
        span_s = self._points[-1].arrival_s - self._points[0].arrival_s
        is_drift = beyond_largest_s >= max(MIN_DRIFT_S, MAX_RATE_ERROR * span_s * (1.0 - 1.0 / len(steps_s)))
        return is_drift and (steps_s[-1] > 0.0 or is_below_floor)


def _has_reversed(steps_s: list[float]) -> bool:
    """Return True if the last step is opposite to the drift before it."""
    return len(steps_s) > 1 and steps_s[-1] * sum(steps_s[:-1]) < 0.0


def _drift_s(before: Point, after: Point) -> float:
    """Return the change of the delay between two points [s]; 0 within ``MAX_RATE_ERROR``."""
    drift_s = after.delay_s - before.delay_s
    return drift_s if abs(drift_s) > MAX_RATE_ERROR * (after.arrival_s - before.arrival_s) else 0.0


def _rate_fault(rate: float) -> str:
    unit = next((text for factor, text in _UNITS.items() if abs(rate / factor - 1.0) < UNIT_TOLERANCE), "")
    cause = f"its times are {unit}: correct the unit" if unit else "correct its clock, or do not send its times"
    return f"the clock of the source runs at {rate:.3g} times the rate of the arrivals, which are used instead; {cause}"


MAX_LEAD_S = 5.0
"""Maximum time by which a sample may arrive before its time [s]. A larger lead shows that the clock was set."""
MAX_CONSTANT_S = 10.0
"""Maximum time for which a timestamp may stay constant while samples arrive [s]. Then the timestamp is ignored."""
MAX_SLOWNESS = 0.01
"""Maximum relative amount by which a device's clock is slower than the host's."""
MAX_FIRST_BACKLOG_S = 1.0
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
    After ``MAX_FIRST_BACKLOG_S`` the least delay never decreases, so that the leads of several timestamps do not add up.

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
        if step_s == 0.0 and elapsed_s < MAX_CONSTANT_S and not self._rate.fault:  # samples may share a timestamp
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
        if not self.jumps and arrival_s - self._first_s <= MAX_FIRST_BACKLOG_S:
            self._min_delay_s = min(self._min_delay_s, delay_s)
        else:
            increased_s = self._min_delay_s + MAX_SLOWNESS * min(step_s, elapsed_s)
            self._min_delay_s = min(increased_s, max(self._min_delay_s, delay_s))
