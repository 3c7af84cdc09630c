"""Plans of the guided tests, and the limits of a pack that they respect."""

import math
from dataclasses import dataclass

REST_C_RATE = 0.03
"""Maximum C-rate of a rest [1/h]. It covers the offset of a current sensor that was not zeroed."""
KNEE_SOC = 0.03
"""SOC drawn in the first discharge. An OCV fitted to exact points of the generic cell `lfp` at SOC 1, 0.9, 0.8 and so on has
errors up to 107 mV between SOC 0.9 and 1. With a further point at SOC 0.97, they are up to 6 mV."""


@dataclass(frozen=True)
class Plan:
    """Relaxation test from full to empty: discharges with a rest after each.

    The first step from full is divided by a further rest, because the OCV of most cells bends there.

    Attributes:
        name: Name on the command line.
        load_c_rate: Current of the discharges as a C-rate [1/h].
        step_soc: SOC drawn from one rest to the next.
        rest_s: Duration of the rest after each discharge [s].
        full_rest_s: Duration of the rest after the charge [s].
    """

    name: str
    load_c_rate: float
    step_soc: float
    rest_s: float
    full_rest_s: float

    def discharge_soc(self, number: int) -> float:
        """Return the SOC to draw in a discharge, whose ``number`` counts from 1."""
        return {1: KNEE_SOC, 2: self.step_soc - KNEE_SOC}.get(number, self.step_soc)

    def remaining_rests(self, drawn_soc: float) -> int:
        """Return the number of rests after further discharges, when ``drawn_soc`` (0..1) has been drawn since full."""
        # one rest after each remaining step, and the rest at the knee; the tolerance absorbs rounding
        steps = math.ceil(max(1.0 - drawn_soc, 0.0) / self.step_soc - 1e-6)
        return steps + (drawn_soc < KNEE_SOC * (1.0 - 1e-6))


SHORT = Plan("short", load_c_rate=0.5, step_soc=0.1, rest_s=360.0, full_rest_s=900.0)
"""Eleven discharges with rests of 6 minutes: 3 h 21 min after the charge."""
LONG = Plan("long", load_c_rate=0.5, step_soc=0.05, rest_s=1800.0, full_rest_s=3600.0)
"""Twenty-one discharges with rests of half an hour: 13.5 h after the charge. The voltage relaxes to within a few millivolts in
each rest."""
PLANS = {plan.name: plan for plan in (SHORT, LONG)}


@dataclass(frozen=True)
class Limits:
    """Limits of a pack. Voltages and currents are those at its terminals.

    Attributes:
        capacity_ah: Rated capacity [Ah].
        series_count: Number of cells in series.
        full_v: Voltage at which the charger ends a charge [V].
        tail_a: Charge current at which the charger ends a charge [A].
        cutoff_v: Voltage at which a discharge ends [V].
        min_cell_v: Voltage of the lowest cell at which a discharge ends [V].
        max_cell_v: Voltage of the highest cell at which a charge must end [V].
        max_discharge_a: Maximum discharge current [A].
        max_temperature_c: Maximum temperature [°C].
    """

    capacity_ah: float
    series_count: int
    full_v: float
    tail_a: float
    cutoff_v: float
    min_cell_v: float
    max_cell_v: float
    max_discharge_a: float
    max_temperature_c: float

    @property
    def rest_a(self) -> float:
        """Maximum current of a rest, in both directions [A]."""
        return REST_C_RATE * self.capacity_ah
