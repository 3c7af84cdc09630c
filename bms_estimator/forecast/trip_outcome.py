"""Outcome of a trip: whether the charge is enough, and the state of the pack at the end."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from bms_estimator.forecast.forecast import ForecastCurve
from bms_estimator.forecast.given_load import GivenLoad
from bms_estimator.forecast.trip import Trip

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
