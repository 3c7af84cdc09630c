"""One alarm: hysteresis, delays, latch. Pure: it uses the time of the samples and no clock."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from bms_estimator.model.arrays import Floats
from bms_estimator.settings.alarm_limits import AlarmDefinition


class RaisedAlarm(NamedTuple):
    """Time and value at which an alarm was raised."""

    since_s: float
    """Wall clock [s since 1970]."""
    value: float | None


class AlarmTransition(NamedTuple):
    """Start or end of an alarm."""

    at_s: float
    """On the samples' clock [s]."""
    raising: RaisedAlarm | None
    """Raised alarm; None: it has ended."""


@dataclass
class AlarmState:
    """State of an alarm.

    Attributes:
        watched: Definition of the alarm.
        raising: Time and value of an active alarm; None if inactive.
        cause_cleared: The cause is gone, but it is latched.
        acknowledged: True if acknowledged: the alarm ends once its cause is gone.
        known: A value has arrived.
        lost_s: Shorter times without values count toward a delay [s].
    """

    watched: AlarmDefinition
    raising: RaisedAlarm | None = None
    cause_cleared: bool = False
    acknowledged: bool = False
    known: bool = False
    lost_s: float = 0.0
    _missing_s: float = 0.0
    """Time without values since the last value [s]."""
    _held_s: float | None = None
    """Time for which the condition of the next state has held [s]; None: it does not hold."""

    def take(self, times_s: Floats, steps_s: Floats, values: Floats, wall_s: float) -> list[AlarmTransition]:
        """Take values in the order of their arrival.

        Args:
            times_s: Shape (n,): when, on the samples' clock [s].
            steps_s: Shape (n,): since the sample before, 0 after a gap [s]: an unmeasured time does not count.
            values: Shape (n,): in the unit of the limit; NaN: not measured, which neither raises nor ends anything.
            wall_s: Wall clock less the samples' clock [s].

        Returns:
            Turns within, oldest first.
        """
        sign = 1.0 if self.watched.above else -1.0
        signed = sign * values
        if self.raising is None and self._held_s is None and not bool((signed >= sign * self.watched.limit).any()):
            self.known = self.known or not bool(np.isnan(values).all())
            return []
        turns = []
        for at_s, step_s, value in zip(times_s.tolist(), steps_s.tolist(), signed.tolist(), strict=True):
            if math.isnan(value):
                self._missing_s += step_s
                continue
            self.known = True
            missing_s, self._missing_s = self._missing_s, 0.0
            if self._due(value, step_s + (missing_s if missing_s < self.lost_s else 0.0), sign):
                turns += self._turn(at_s, sign * value, wall_s)
        return turns

    def raise_at(self, at_s: float, raising: RaisedAlarm) -> list[AlarmTransition]:
        """Raise the alarm, unless it is already raised."""
        if self.raising is not None:
            return []
        self.raising, self._held_s = raising, None
        return [AlarmTransition(at_s, raising)]

    def acknowledge(self) -> bool:
        """Acknowledge the alarm. Return True if that ends it."""
        self.acknowledged = self.raising is not None
        if not self.cause_cleared:
            return False
        self._end()
        return True

    def restore(self, raising: RaisedAlarm, *, gone: bool, acknowledged: bool) -> None:
        """Go on from a run before."""
        self.raising, self.cause_cleared, self.acknowledged = raising, gone, acknowledged
        self._held_s = None

    def _due(self, signed: float, step_s: float, sign: float) -> bool:
        """Return True if the condition of the next state has held long enough."""
        raised = self.raising is not None and not self.cause_cleared
        holds = signed < sign * self.watched.clear if raised else signed >= sign * self.watched.limit
        if not holds:
            self._held_s = None
            return False
        self._held_s = 0.0 if self._held_s is None else self._held_s + step_s
        if self._held_s < (self.watched.clear_delay_s if raised else self.watched.delay_s):
            return False
        self._held_s = None
        return True

    def _turn(self, at_s: float, value: float, wall_s: float) -> list[AlarmTransition]:
        """Go to the next state. Returns the transition for others."""
        if self.raising is None:
            return self.raise_at(at_s, RaisedAlarm(at_s + wall_s, value if math.isfinite(value) else None))
        if self.cause_cleared:  # it is back
            self.cause_cleared = False
            return []
        if self.watched.latch and not self.acknowledged:
            self.cause_cleared = True
            return []
        self._end()
        return [AlarmTransition(at_s, None)]

    def _end(self) -> None:
        self.raising, self.cause_cleared, self.acknowledged, self._held_s = None, False, False, None
