"""Payload of the topic ``forecast``, and the fields of the topic ``state`` that a forecast supplies."""

import math
from typing import Any

from bms_estimator.forecast.forecast import FORECAST, Forecast, unknown_values
from bms_estimator.model.arrays import Floats
from bms_estimator.model.clock import iso_utc
from bms_estimator.model.payloads.forecast import ForecastReport
from bms_estimator.telemetry.publish_window import WindowSummary

NAMES = FORECAST.names or ()
"""Fields of ``Estimate`` that a forecast supplies."""
DURATIONS = tuple(name for name in NAMES if name.startswith("time_to_"))
"""Fields that are durations, which decrease between two forecasts [s]."""
CURVES = ("soc_p05", "soc_p50", "soc_p95", "voltage_p05_v", "voltage_p50_v", "voltage_p95_v", "survival")
"""Fields of ``ForecastCurve`` and ``ForecastReport``."""


def no_forecast(reason: str) -> Forecast:
    """Return a forecast without values, for a pack without a forecaster."""
    return Forecast(math.nan, unknown_values(), reason, None)


def forecast_fields(forecast: Forecast, time_s: float) -> dict[str, Any]:
    """Return the fields of ``Estimate`` that a forecast supplies. Durations count from the published sample.

    Args:
        forecast: The last forecast.
        time_s: Time stamp of the published sample [s].
    """
    elapsed_s = max(time_s - forecast.time_s, 0.0)
    values = dict(zip(NAMES, forecast.values[0].item(), strict=True))
    values |= {name: max(values[name] - elapsed_s, 0.0) for name in DURATIONS if math.isfinite(values[name])}
    known = {name: value if math.isfinite(value) else None for name, value in values.items()}
    return known | {"forecast_reason": forecast.reason}


def make_forecast_payload(forecast: Forecast, cutoff_v: float, window: WindowSummary, now_s: float) -> ForecastReport:
    """Return the payload of the topic ``forecast``.

    Args:
        forecast: The last forecast.
        cutoff_v: Voltage at which the load is switched off [V].
        window: Summary since the last publication.
        now_s: Wall clock [s since 1970].
    """
    curve = forecast.curve
    age_s = max(float(window.last["time_s"]) - forecast.time_s, 0.0)
    return ForecastReport(
        time=iso_utc(max(window.arrival_s - age_s, 0.0) if math.isfinite(age_s) else window.arrival_s),
        publish_time=iso_utc(now_s),
        reason=forecast.reason,
        cutoff_v=cutoff_v,
        elapsed_s=_numbers(curve.elapsed_s) if curve else [],
        **{name: _numbers(getattr(curve, name)) if curve else [] for name in CURVES},
    )


def _numbers(values: Floats) -> list[float | None]:
    """Return values with five significant digits; None for NaN."""
    return [float(f"{value:.5g}") if math.isfinite(value) else None for value in values.tolist()]
