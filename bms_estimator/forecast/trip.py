"""Trip: a future load that the user gives, as a constant or a profile, and its outcome."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from bms_estimator.forecast.available_power import ForecastCurve
from bms_estimator.model.arrays import Floats
from bms_estimator.model.errors import UserError


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


LoadQuantity = Literal["current_a", "power_w"]
"""Quantity of a load: current [A] or power [W], positive on discharge."""

MAX_LOAD = 1e6
"""Maximum absolute current [A] or power [W] of a load."""
MAX_TRIP_S = 7.0 * 86_400.0
"""Maximum duration of a trip [s]."""
MAX_POINTS = 1_000_000
"""Maximum number of points of a profile."""
CONSTANT_PART_S = 3600.0
"""Duration of the single part of a constant load without an end [s]. The part repeats, so that any duration is equivalent."""


@dataclass(frozen=True)
class Trip:
    """Future load that the user gives.

    Attributes:
        load: The load.
        has_end: True if the trip ends with the last part of the load; False if the load continues without an end.
    """

    load: GivenLoad
    has_end: bool


def constant_trip(quantity: LoadQuantity, value: float, duration_s: float | None = None) -> Trip:
    """Return a trip with a constant load.

    Args:
        quantity: Quantity of the load.
        value: Current [A] or power [W], positive on discharge.
        duration_s: Duration [s]; None: the load has no end.

    Raises:
        UserError: The load is not a number, or too large; the duration is not positive, or too long.
    """
    values = np.array([value])
    _check_values(quantity, values, "")
    if duration_s is not None and not 0.0 < duration_s <= MAX_TRIP_S:
        raise UserError(f"duration_s = {duration_s:g}: must be above 0 and at most {MAX_TRIP_S:g} (seven days)")
    return Trip(
        _given_load(quantity, np.array([duration_s or CONSTANT_PART_S]), values), has_end=duration_s is not None
    )


def profile_trip(quantity: LoadQuantity, time_s: Floats, values: Floats) -> Trip:
    """Return a trip whose load is a profile. The load is constant from each point to the next; the last point is the end.

    Args:
        quantity: Quantity of the load.
        time_s: Time of each point [s], shape (n,), increasing.
        values: Current [A] or power [W] from each point on, positive on discharge, shape (n,). The last one is ignored.

    Raises:
        UserError: There are too few or too many points, the times do not increase, the trip is too long, or a value is not a
            number or too large.
    """
    if not 2 <= time_s.size <= MAX_POINTS:
        raise UserError(f"{time_s.size} points: must be 2 to {MAX_POINTS:,}, of which the last is the end of the trip")
    duration_s = np.diff(time_s)
    invalid = np.flatnonzero(~(duration_s > 0.0))
    if invalid.size:
        before_s, after_s = time_s[invalid[0] : invalid[0] + 2]
        raise UserError(f"point {invalid[0] + 2}: time_s = {after_s:g} after {before_s:g}: must increase")
    if not time_s[-1] - time_s[0] <= MAX_TRIP_S:
        raise UserError(f"lasts {time_s[-1] - time_s[0]:g} s: must be at most {MAX_TRIP_S:g} s (seven days)")
    _check_values(quantity, values[:-1], "point {}: ")
    return Trip(_given_load(quantity, duration_s, values[:-1]), has_end=True)


def _check_values(quantity: LoadQuantity, values: Floats, place: str) -> None:
    """Check that all values are numbers and not too large.

    Args:
        quantity: Quantity of the values.
        values: Values [A] or [W].
        place: Beginning of the error; ``{}`` in it is replaced by the number of the value, from 1.

    Raises:
        UserError: A value is not a number, or too large.
    """
    invalid = np.flatnonzero(~(np.abs(values) <= MAX_LOAD))
    if invalid.size:
        raise UserError(
            f"{place.format(invalid[0] + 1)}{quantity} = {values[invalid[0]]:g}: must be a number from {-MAX_LOAD:g} to {MAX_LOAD:g}"
        )


def _given_load(quantity: LoadQuantity, duration_s: Floats, values: Floats) -> GivenLoad:
    unknown = np.full(values.size, np.nan)
    if quantity == "current_a":
        return GivenLoad(duration_s, current_a=values.astype(float), power_w=unknown)
    return GivenLoad(duration_s, current_a=unknown, power_w=values.astype(float))


Verdict = Literal["enough", "uncertain", "not enough"]
"""Answer to the question whether the charge is enough for a trip."""
MIN_CERTAINTY = 0.95
"""Minimum probability of the verdicts ``enough`` and ``not enough``."""


@dataclass(frozen=True)
class TripOutcome:
    """Outcome of a trip.

    Attributes:
        duration_s: Duration of the trip [s].
        energy_wh: Energy that the trip needs [Wh]; charging during the trip counts as negative.
        enough_probability: Probability that the cut-off comes after the end of the trip, 0..1.
        verdict: ``enough`` or ``not enough`` with a probability of at least ``MIN_CERTAINTY``, otherwise ``uncertain``.
        soc_p05, soc_p50, soc_p95: Quantiles of the SOC at the end of the trip, or at an earlier cut-off, 0..1.
        voltage_p05_v, voltage_p50_v, voltage_p95_v: Quantiles of the terminal voltage at the end of the trip [V]. After a
            cut-off it is the cut-off voltage.
    """

    duration_s: float
    energy_wh: float
    enough_probability: float
    verdict: Verdict
    soc_p05: float
    soc_p50: float
    soc_p95: float
    voltage_p05_v: float
    voltage_p50_v: float
    voltage_p95_v: float


def trip_outcome(trip: Trip, curve: ForecastCurve) -> TripOutcome:
    """Return the outcome of a trip.

    Args:
        trip: The trip.
        curve: Curves until the end of the trip, of ``Forecaster.given_load_curve``.
    """
    probability = float(curve.survival[-1])
    return TripOutcome(
        duration_s=float(trip.load.duration_s.sum()),
        energy_wh=_energy_wh(trip.load, curve),
        enough_probability=probability,
        verdict=_verdict(probability),
        soc_p05=float(curve.soc_p05[-1]),
        soc_p50=float(curve.soc_p50[-1]),
        soc_p95=float(curve.soc_p95[-1]),
        voltage_p05_v=float(curve.voltage_p05_v[-1]),
        voltage_p50_v=float(curve.voltage_p50_v[-1]),
        voltage_p95_v=float(curve.voltage_p95_v[-1]),
    )


def _energy_wh(load: GivenLoad, curve: ForecastCurve) -> float:
    """Return the energy of a load [Wh]. A current is converted to power with the median voltage."""
    middle_s = np.cumsum(load.duration_s) - 0.5 * load.duration_s
    voltage_v = np.interp(middle_s, curve.elapsed_s, curve.voltage_p50_v)
    power_w = np.where(np.isnan(load.power_w), load.current_a * voltage_v, load.power_w)
    return float(power_w @ load.duration_s) / 3600.0


def _verdict(probability: float) -> Verdict:
    if probability >= MIN_CERTAINTY:
        return "enough"
    return "not enough" if probability <= 1.0 - MIN_CERTAINTY else "uncertain"
