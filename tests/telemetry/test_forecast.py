"""Payloads of a forecast: durations between two forecasts, unknown values, curves, and the text of the views."""

import numpy as np
import pytest

from bms_estimator.kernels.records import TRACE
from bms_estimator.model.clock import iso_utc
from bms_estimator.model.payloads.estimate import Estimate
from bms_estimator.model.payloads.snapshot import ForecastReport
from bms_estimator.telemetry.publish_window import Window, WindowSummary
from bms_estimator.telemetry.state import (
    FORECAST_FIELDS,
    cutoff_text,
    forecast_fields,
    make_forecast_payload,
    no_forecast,
)
from tests.sinks.snapshots import CUTOFF_V, NOW, forecast_at

FORECAST = forecast_at(600.0)


def window_at(time_s: float) -> WindowSummary:
    """Return the summary of a window with one sample at ``time_s``."""
    window, trace = Window(), np.zeros(1, TRACE)
    trace["time_s"] = time_s
    window.add(trace, NOW)
    summary = window.take()
    assert summary
    return summary


def test_every_value_of_a_forecast_is_a_field_of_the_state() -> None:
    assert set(FORECAST_FIELDS) < set(Estimate.model_fields)


def test_durations_decrease_between_two_forecasts_and_probabilities_do_not() -> None:
    fields = forecast_fields(FORECAST, FORECAST.time_s + 7.0)
    assert fields["time_to_cutoff_s"] == pytest.approx(593.0)
    assert fields["time_to_cutoff_p05_s"] == pytest.approx(0.75 * 600.0 - 7.0)
    assert fields["cutoff_within_5min"] == 0.002
    assert forecast_fields(FORECAST, FORECAST.time_s + 1e4)["time_to_cutoff_s"] == 0.0


def test_durations_do_not_grow_if_the_clock_of_the_samples_is_set_back() -> None:
    assert forecast_fields(FORECAST, FORECAST.time_s - 50.0)["time_to_cutoff_s"] == 600.0


def test_unknown_values_are_null_and_the_reason_is_published() -> None:
    fields = forecast_fields(no_forecast("the pack is charged"), 5.0)
    assert fields == dict.fromkeys(FORECAST_FIELDS) | {"forecast_reason": "the pack is charged"}
    assert forecast_fields(FORECAST, 5.0)["available_charge_power_10s_w"] is None


def test_curves_begin_at_the_arrival_of_the_sample_of_the_forecast() -> None:
    report = make_forecast_payload(FORECAST, CUTOFF_V, window_at(FORECAST.time_s + 4.0), NOW + 1.0)
    assert (report.time, report.publish_time) == (iso_utc(NOW - 4.0), iso_utc(NOW + 1.0))
    lists = [value for name, value in report if isinstance(value, list)]
    assert {len(values) for values in lists} == {FORECAST.curve.elapsed_s.size}
    assert report.voltage_p50_v == pytest.approx(FORECAST.curve.voltage_p50_v, rel=1e-4)
    assert ForecastReport.model_validate_json(report.json_bytes) == report


def test_a_report_without_a_forecast_has_empty_curves_and_a_reason() -> None:
    report = make_forecast_payload(no_forecast("no load was seen"), CUTOFF_V, window_at(1.0), NOW)
    assert (report.reason, report.elapsed_s, report.survival) == ("no load was seen", [], [])


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ((6720.0, 4800.0, 9060.0, 0.0), "1:52 h (1:20 to 2:31)"),
        ((599.0, 180.0, 900.0, 0.4), "3 to 15 min, 40 % within 5 min"),
        ((599.0, 180.0, 900.0, None), "3 to 15 min"),
        ((None, None, None, None), None),
    ],
)
def test_below_ten_minutes_the_text_has_the_band_and_the_probability_only(values: tuple[float, ...], text: str) -> None:
    assert cutoff_text(*values) == text


def test_curves_from_before_a_jump_of_the_samples_clock_have_a_time_that_can_be_published() -> None:
    report = make_forecast_payload(FORECAST, CUTOFF_V, window_at(FORECAST.time_s + 1e12), NOW)
    assert report.time == iso_utc(0.0)
