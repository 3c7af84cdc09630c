"""Forecast of a pack: values at one sample, and curves over the time after it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bms_estimator.model.arrays import Floats

FORECAST = np.dtype(
    [
        ("time_to_cutoff_s", "f8"),  # median time until the terminal voltage reaches the cut-off voltage [s]
        ("time_to_cutoff_p05_s", "f8"),  # 5 % quantile of that time [s]
        ("time_to_cutoff_p95_s", "f8"),  # 95 % quantile of that time [s]
        ("cutoff_within_2min", "f8"),  # probability of the cut-off within 120 s, 0..1
        ("cutoff_within_5min", "f8"),  # probability of the cut-off within 300 s, 0..1
        ("cutoff_within_15min", "f8"),  # probability of the cut-off within 900 s, 0..1
        ("time_to_full_s", "f8"),  # time until the charger ends the present charge [s]
        ("usable_capacity_ah", "f8"),  # charge to the cut-off at the present load and temperature [Ah]
        ("remaining_energy_wh", "f8"),  # energy at the terminals to the cut-off at the present load [Wh]
        ("available_discharge_power_10s_w", "f8"),  # constant power that the pack supplies for 10 s [W]
        ("available_discharge_power_60s_w", "f8"),  # constant power that the pack supplies for 60 s [W]
        ("available_charge_power_10s_w", "f8"),  # constant power that the pack accepts for 10 s [W]
        ("available_charge_power_60s_w", "f8"),  # constant power that the pack accepts for 60 s [W]
    ],
    align=True,
)
"""Values of a forecast; NaN if unknown. The published fields have the same names."""

ForecastRows = NDArray[np.void]
"""Shape (n,), dtype ``FORECAST``."""


@dataclass(frozen=True)
class ForecastCurve:
    """Quantiles as functions of the time after the forecast, each of shape (n,).

    Attributes:
        elapsed_s: Time from the forecast [s], increasing.
        soc_p05, soc_p50, soc_p95: Quantiles of the SOC, 0..1.
        voltage_p05_v, voltage_p50_v, voltage_p95_v: Quantiles of the terminal voltage [V].
        survival: Probability that the cut-off is later than ``elapsed_s``, 0..1.
    """

    elapsed_s: Floats
    soc_p05: Floats
    soc_p50: Floats
    soc_p95: Floats
    voltage_p05_v: Floats
    voltage_p50_v: Floats
    voltage_p95_v: Floats
    survival: Floats


@dataclass(frozen=True)
class Forecast:
    """Forecast at one sample.

    Attributes:
        time_s: Time stamp of the sample [s].
        values: Shape (1,), dtype ``FORECAST``.
        reason: Reason why the time to the cut-off is unknown; None if it is known.
        curve: Curves; None without a time to the cut-off.
    """

    time_s: float
    values: ForecastRows
    reason: str | None
    curve: ForecastCurve | None


def unknown_values() -> ForecastRows:
    """Return values that are all unknown, shape (1,), dtype ``FORECAST``."""
    return np.array([(np.nan,) * len(FORECAST.names or ())], FORECAST)


NO_FORECAST = unknown_values()
"""Forecast at all samples of a pack without forecasts."""
