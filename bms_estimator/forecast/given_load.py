"""Future load of a forecast, as a list of parts."""

from dataclasses import dataclass

import numpy as np

from bms_estimator.model.arrays import Floats


@dataclass(frozen=True)
class GivenLoad:
    """Future load, in parts with a constant current or power. It repeats after its last part.

    The user gives it, or it is the load that followed a similar load in the past (``PastMinutes.analogues``).

    Attributes:
        duration_s: Duration of each part [s], shape (n,), above 0.
        current_a: Current of each part [A], positive on discharge, shape (n,); NaN where ``power_w`` is given.
        power_w: Power of each part [W], positive on discharge, shape (n,); NaN where ``current_a`` is given.
    """

    duration_s: Floats
    current_a: Floats
    power_w: Floats

    def largest_current_a(self, voltage_v: float) -> float:
        """Return the largest current [A], at least 0. A power is converted to a current at ``voltage_v``."""
        current_a = np.where(np.isnan(self.current_a), self.power_w / voltage_v, self.current_a)
        return float(current_a.max(initial=0.0))
