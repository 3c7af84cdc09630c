"""Load that the user gives for a forecast."""

from dataclasses import dataclass

from bms_estimator.model.arrays import Floats


@dataclass(frozen=True)
class GivenLoad:
    """Future load, in parts with a constant current or power. It repeats after its last part.

    Attributes:
        duration_s: Duration of each part [s], shape (n,), above 0.
        current_a: Current of each part [A], positive on discharge, shape (n,); NaN where ``power_w`` is given.
        power_w: Power of each part [W], positive on discharge, shape (n,); NaN where ``current_a`` is given.
    """

    duration_s: Floats
    current_a: Floats
    power_w: Floats
