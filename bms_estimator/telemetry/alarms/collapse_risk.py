"""Value and text of the alarm ``collapse_risk``: the probability of the cut-off within 5 min that the forecast gives."""

import numpy as np

from bms_estimator.forecast.forecast import ForecastRows
from bms_estimator.model.arrays import Floats


def collapse_risks(forecasts: ForecastRows, is_charging: np.ndarray) -> Floats:
    """Return the value of the alarm ``collapse_risk`` at each forecast, shape (n,), 0..1.

    It is the probability of the cut-off within 5 min. Without a forecast it is 0 during a charge, and otherwise NaN.

    Args:
        forecasts: Forecasts, shape (n,), dtype FORECAST.
        is_charging: True at samples with a charge current, shape (n,).
    """
    probability: Floats = forecasts["cutoff_within_5min"]
    return np.where(np.isnan(probability) & is_charging, 0.0, probability)


def time_left_text(forecast: np.void) -> str:
    """Return a sentence with the 90 % band of the time to the cut-off, from a record of FORECAST."""
    early_min, late_min = (float(forecast[f"time_to_cutoff_{name}_s"]) / 60.0 for name in ("p05", "p95"))
    return f"the time left was {early_min:.0f} to {late_min:.0f} min (90 % band) when the alarm was raised"
