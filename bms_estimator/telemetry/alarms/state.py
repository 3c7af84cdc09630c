"""State machine of one alarm: hysteresis, delays, latch. It uses the times of the samples and reads no clock."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bms_estimator.model.arrays import Floats
from bms_estimator.settings.alarm_limits import AlarmDefinition


class RaisedAlarm(NamedTuple):
    """Time and value at which an alarm was raised."""

    since_s: float
    """Time on the wall clock at which the alarm was raised [s since 1970]."""
    value: float | None
    """Value in the unit of the alarm; None if the alarm has no number."""


class AlarmTransition(NamedTuple):
    """Start or end of an alarm."""

    at_s: float
    """Time on the samples' clock [s]."""
    raised: RaisedAlarm | None
    """The raised alarm; None: the alarm has ended."""


@dataclass
class AlarmState:
    """State of an alarm.

    Attributes:
        definition: Definition of the alarm.
        raised: Time and value of an active alarm; None if inactive.
        cause_cleared: True if the cause is gone but the alarm is latched.
        acknowledged: True if the alarm is acknowledged, so that it ends once its cause is gone.
        has_value: True once a value has arrived.
        lost_s: Maximum time without values that counts toward a delay [s].
    """

    definition: AlarmDefinition
    raised: RaisedAlarm | None = None
    cause_cleared: bool = False
    acknowledged: bool = False
    has_value: bool = False
    lost_s: float = 0.0
    _missing_s: float = 0.0
    """Time without values since the last value [s]."""
    _held_s: float | None = None
    """Time for which the condition of the next state has held [s]; None: it does not hold."""
    _is_uncertain: bool = False
    """True if the last value was uncertain, and the measured one was not beyond the limit."""
    _accepts_uncertain: bool = False
    """True if the alarm was acknowledged at an uncertain value, and no measured value has been beyond the limit since."""

    @property
    def is_pending(self) -> bool:
        """True while the delay before the alarm runs."""
        return self.raised is None and self._held_s is not None

    def update(
        self,
        times_s: Floats,
        steps_s: Floats,
        values: Floats,
        wall_offset_s: float,
        uncertain: NDArray[np.bool_] | None = None,
    ) -> list[AlarmTransition]:
        """Process values in the order of their arrival.

        Args:
            times_s: Times on the samples' clock [s], shape (n,).
            steps_s: Interval since the previous sample [s], 0 after a gap, which does not count toward delays; shape (n,).
            values: Values in the unit of the limit, shape (n,). NaN (not measured) neither raises nor ends the alarm.
            wall_offset_s: Wall clock minus the samples' clock [s].
            uncertain: True where the true value may be beyond the limit, shape (n,). Such a value neither ends the alarm nor its
                delay, unless the alarm was acknowledged at such a value and no measured one has been beyond the limit since.
                None: nowhere.

        Returns:
            Transitions, oldest first.
        """
        sign = 1.0 if self.definition.kind.is_upper_limit else -1.0  # lower limits are upper limits of negative values
        signed = sign * values
        # the usual case: no value reaches the limit
        if self.raised is None and self._held_s is None and not bool((signed >= sign * self.definition.limit).any()):
            self.has_value = self.has_value or not bool(np.isnan(values).all())
            return []
        transitions = []
        are_uncertain = [False] * values.size if uncertain is None else uncertain.tolist()
        rows = zip(times_s.tolist(), steps_s.tolist(), signed.tolist(), are_uncertain, strict=True)
        for at_s, step_s, measured, is_uncertain in rows:
            is_beyond = measured >= sign * self.definition.limit
            self._is_uncertain = is_uncertain and not is_beyond
            if is_beyond:  # the acknowledgment did not cover the loss of this sensor
                self._accepts_uncertain = False
            keeps_state = is_uncertain and (self.is_pending or (self.raised and not self._accepts_uncertain))
            value = max(sign * self.definition.limit, measured) if keeps_state else measured
            if math.isnan(value):
                self._missing_s += step_s
                continue
            self.has_value = True
            missing_s, self._missing_s = self._missing_s, 0.0
            if self._is_due(value, step_s + (missing_s if missing_s < self.lost_s else 0.0), sign):
                transitions += self._next_state(at_s, sign * value, wall_offset_s)
        return transitions

    def raise_at(self, at_s: float, raised: RaisedAlarm) -> list[AlarmTransition]:
        """Raise the alarm, unless it is already raised."""
        if self.raised is not None:
            return []
        self.raised, self._held_s = raised, None
        return [AlarmTransition(at_s, raised)]

    def acknowledge(self) -> bool:
        """Acknowledge the alarm. Return True if that ends it."""
        self.acknowledged = self.raised is not None
        self._accepts_uncertain = self._is_uncertain
        if self.cause_cleared and self._held_s is not None:  # the cause has returned, and the delay runs
            self.cause_cleared, self._held_s = False, None
        if not self.cause_cleared:
            return False
        self._end()
        return True

    def restore(self, raised: RaisedAlarm, *, cause_cleared: bool, acknowledged: bool) -> None:
        """Restore the state of an earlier run."""
        self.raised, self.cause_cleared, self.acknowledged = raised, cause_cleared, acknowledged
        self._held_s = None

    def resume_delay(self) -> None:
        """Resume the delay of an earlier run. It counts as elapsed, so that a crash loop cannot prevent the alarm."""
        if self.raised is None:
            self._held_s = math.inf

    def _is_due(self, signed: float, step_s: float, sign: float) -> bool:
        """Return True if the condition of the next state has held long enough."""
        waits_for_end = self.raised is not None and not self.cause_cleared
        holds = signed < sign * self.definition.clear if waits_for_end else signed >= sign * self.definition.limit
        if not holds:
            self._held_s = None
            return False
        self._held_s = 0.0 if self._held_s is None else self._held_s + step_s
        if self._held_s < (self.definition.clear_delay_s if waits_for_end else self.definition.delay_s):
            return False
        self._held_s = None
        return True

    def _next_state(self, at_s: float, value: float, wall_offset_s: float) -> list[AlarmTransition]:
        """Change to the next state. Return the transition if the alarm is raised or ends."""
        if self.raised is None:
            return self.raise_at(at_s, RaisedAlarm(at_s + wall_offset_s, value if math.isfinite(value) else None))
        if self.cause_cleared:  # the cause has returned
            self.cause_cleared = False
            return []
        if self.definition.latch and not self.acknowledged:
            self.cause_cleared = True
            return []
        self._end()
        return [AlarmTransition(at_s, None)]

    def _end(self) -> None:
        self.raised, self.cause_cleared, self.acknowledged, self._held_s = None, False, False, None
        self._accepts_uncertain = False
