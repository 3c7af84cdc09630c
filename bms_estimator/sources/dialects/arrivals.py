"""Times of samples whose device tells none: by arrival."""

import math

import numpy as np
from numpy.typing import NDArray


class ArrivalTimes:
    """Since the first sample [s]; those that came together share the time since the read before evenly."""

    def __init__(self) -> None:
        self._first_s = self._last_s = math.nan

    def of(self, arrival_s: float, count: int) -> NDArray[np.float64]:
        """Times of ``count`` samples, at least one, that came in one read [s].

        Args:
            arrival_s: When they came, on any clock that never steps back [s].
            count: How many.
        """
        if math.isnan(self._last_s):
            self._first_s = self._last_s = arrival_s
            return np.zeros(count)
        steps = np.arange(1, count + 1) / count
        times: NDArray[np.float64] = self._last_s + (arrival_s - self._last_s) * steps - self._first_s
        self._last_s = arrival_s
        return times
