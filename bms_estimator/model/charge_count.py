"""Charge as the integral of a sampled current, and faults of the timestamps: steps back and gaps."""

import math

import numpy as np

from bms_estimator.model.arrays import Floats, Masks
from bms_estimator.model.unmeasured_time import MAX_FLOW_S, UNMEASURED_S

MIN_GAP_PERIODS = 10.0
"""Minimum duration of a gap in multiples of the median sample period."""
MIN_GAP_TO_LONG_PERIOD = 1.5
"""Minimum duration of a gap in multiples of the 99th percentile of the sample period. Many loggers record rests at a longer
period. The percentile includes this period, so that such steps are not gaps."""


class TimeFaults:
    """Counter of the steps back and of the gaps in the times of a capture, block by block.

    Attributes:
        backward_steps: Number of samples whose time is before the previous sample's time.
        gaps: Number of steps that are longer than ``gap_s`` of their block.
    """

    def __init__(self) -> None:
        self.backward_steps = self.gaps = 0
        self._last_s = math.nan
        self._first_back_s = (0.0, 0.0)  # times before and after the step
        self._longest_gap_s = (0.0, 0.0)  # time of its start, and duration

    def add(self, time_s: Floats) -> None:
        """Add the times of a block."""
        finite_s = np.concatenate([[self._last_s], time_s])
        finite_s = finite_s[np.isfinite(finite_s)]
        if finite_s.size < 2:
            self._last_s = float(finite_s[-1]) if finite_s.size else math.nan
            return
        step_s = np.diff(finite_s)
        if (step_s < 0.0).any() and not self.backward_steps:
            first = int(np.argmax(step_s < 0.0))
            self._first_back_s = float(finite_s[first]), float(finite_s[first + 1])
        self.backward_steps += int(np.count_nonzero(step_s < 0.0))
        self.gaps += int(np.count_nonzero(step_s > gap_s(step_s)))
        longest = int(np.argmax(step_s))
        if step_s[longest] > max(gap_s(step_s), self._longest_gap_s[1]):
            self._longest_gap_s = float(finite_s[longest]), float(step_s[longest])
        self._last_s = float(finite_s[-1])

    @property
    def warnings(self) -> list[str]:
        """Faults as text."""
        lines = []
        if self.backward_steps:
            before_s, after_s = self._first_back_s
            lines.append(
                f"steps back in time: {self.backward_steps}, the first from {before_s:g} to {after_s:g} s: a clock was set, or "
                "the test was restarted; a sample is used only if it is later than all before it"
            )
        if self.gaps:
            at_s, longest_s = self._longest_gap_s
            lines.append(f"gaps without samples: {self.gaps}, the longest of {longest_s:g} s after {at_s:g} s")
        return lines


def gap_s(step_s: Floats) -> float:
    """Return the duration from which a step between two samples is a gap [s]; infinite without steps forward."""
    forward_s = step_s[step_s > 0.0]
    if not forward_s.size:
        return math.inf
    return max(
        MIN_GAP_PERIODS * float(np.median(forward_s)), MIN_GAP_TO_LONG_PERIOD * float(np.percentile(forward_s, 99.0))
    )


MIN_LOAD_FRACTION = 0.01
"""Minimum current before or after a gap that counts as a load, as a fraction of the largest current."""


def step_charges_as(time_s: Floats, current_a: Floats) -> Floats:
    """Return the charge from each sample to the next one [As].

    The current is constant until the next sample. Over a gap it is the smaller of the currents before and after it, or 0 if
    their signs differ, as in the estimator. A gap longer than ``MAX_FLOW_S`` carries no charge, because a recording that was
    interrupted for hours does not show which current flowed.

    Args:
        time_s: Shape (n,) [s]. A step back carries no charge.
        current_a: Shape (n,) [A]; the charge has its sign.

    Returns:
        Shape (n - 1,).
    """
    step_s = np.diff(time_s).clip(min=0.0)
    is_gap = step_s > max(gap_s(step_s), UNMEASURED_S)
    held_a = np.where(is_gap, smaller_current_a(current_a), current_a[:-1])
    return np.asarray(np.where(are_long_gaps(time_s), 0.0, held_a) * step_s)


def charge_ah(time_s: Floats, current_a: Floats) -> Floats:
    """Return the sum of ``step_charges_as`` since the first sample, shape (n,) [Ah]."""
    charge_as: Floats = np.r_[0.0, np.cumsum(step_charges_as(time_s, current_a))]
    return charge_as / 3600.0


def smaller_current_a(current_a: Floats) -> Floats:
    """Return the smaller of each current and the next one, or 0 if their signs differ. Shape (n - 1,) [A]."""
    before_a, after_a = current_a[:-1], current_a[1:]
    smaller_a = np.minimum(np.abs(before_a), np.abs(after_a))
    return np.asarray(np.where(before_a * after_a > 0.0, np.copysign(smaller_a, before_a), 0.0))


def are_long_gaps(time_s: Floats) -> Masks:
    """Return which steps between two samples are gaps longer than ``MAX_FLOW_S``. Shape (n - 1,)."""
    step_s = np.diff(time_s)
    return np.asarray(step_s > max(gap_s(step_s), MAX_FLOW_S))


def gap_warnings(time_s: Floats, current_a: Floats) -> list[str]:
    """Return a warning if a current flowed before or after a gap longer than ``MAX_FLOW_S``, whose charge counts as 0."""
    finite = np.isfinite(time_s) & np.isfinite(current_a)
    time_s, current_a = time_s[finite], current_a[finite]
    magnitude_a = np.abs(current_a)
    is_load = magnitude_a > MIN_LOAD_FRACTION * magnitude_a.max(initial=0.0)
    gaps = np.flatnonzero(are_long_gaps(time_s) & (is_load[:-1] | is_load[1:]))
    if not gaps.size:
        return []
    first = int(gaps[0])
    line = (
        f"the current in gaps of more than an hour is unknown and counts as 0 A: number of gaps beside a load: {gaps.size}; "
        f"the first begins at {time_s[first]:g} s and lasts {time_s[first + 1] - time_s[first]:.0f} s, with "
        f"{current_a[first]:g} A before and {current_a[first + 1]:g} A after it"
    )
    return [line]
