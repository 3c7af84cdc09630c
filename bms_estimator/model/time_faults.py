"""Faults of a capture's time: steps back and gaps."""

import math

import numpy as np
from numpy.typing import NDArray

MIN_GAP_PERIODS = 10.0
"""Minimum duration of a gap in multiples of the median sample period."""
MIN_GAP_TO_LONG_PERIOD = 1.5
"""Minimum duration of a gap in multiples of the 99th percentile of the sample period. The percentile excludes the longer
period at which many loggers record rests."""


class TimeFaults:
    """Counter of the steps back and of the gaps in the times of a capture, block by block.

    Attributes:
        backward_steps: Number of samples whose time is before the previous sample's time.
        gaps: Number of steps that are longer than ``gap_s`` of their block.
    """

    def __init__(self) -> None:
        self.backward_steps = self.gaps = 0
        self._last_s = math.nan
        self._first_back_s = self._longest_gap_s = (0.0, 0.0)

    def add(self, time_s: NDArray[np.float64]) -> None:
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
                "the test was restarted; samples that are not later than all before are not used"
            )
        if self.gaps:
            at_s, longest_s = self._longest_gap_s
            lines.append(f"gaps without samples: {self.gaps}, the longest of {longest_s:g} s after {at_s:g} s")
        return lines


def gap_s(step_s: NDArray[np.float64]) -> float:
    """Return the duration from which a step between two samples is a gap [s]; infinite without steps forward."""
    forward_s = step_s[step_s > 0.0]
    if not forward_s.size:
        return math.inf
    return max(
        MIN_GAP_PERIODS * float(np.median(forward_s)), MIN_GAP_TO_LONG_PERIOD * float(np.percentile(forward_s, 99.0))
    )
