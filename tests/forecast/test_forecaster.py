"""Forecast of the time to the cut-off, from samples of a simulated cell."""

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.forecast import projection
from bms_estimator.forecast.available_power import FORECAST
from bms_estimator.forecast.forecaster import MAX_INTERVAL_S, Forecaster
from bms_estimator.forecast.trip import GivenLoad
from bms_estimator.pack.pack import Pack
from bms_estimator.pack_model.slow_fit import SlowFit
from tests.estimator.simulated_cell import TRUTH
from tests.forecast.simulated_load import CUTOFF_V, changing_load, constant_load, cutoff_s, forecasting_pack


@pytest.fixture(scope="module")
def drive():
    """Return samples of the cell from SOC 0.9 to below the cut-off voltage."""
    return changing_load(11_000)


def values_of(forecast, *names):
    return [float(forecast.values[name][0]) for name in names]


BAND = "time_to_cutoff_p05_s", "time_to_cutoff_s", "time_to_cutoff_p95_s"


def test_a_pack_with_a_slow_fit_has_a_forecast_for_each_trace_row(drive):
    estimator = Estimator(TRUTH, initial_soc=0.9)
    step = Pack(estimator, SlowFit(estimator), forecaster=Forecaster(estimator, cutoff_v=CUTOFF_V)).run(drive[:4000])
    assert step.forecasts.size == step.trace.size == 4000
    assert step.forecasts.dtype == FORECAST
    assert np.isnan(step.forecasts["time_to_cutoff_s"][:300]).all()
    assert np.isfinite(step.forecasts["time_to_cutoff_s"][300 + int(MAX_INTERVAL_S) :]).all()


def test_the_band_contains_the_true_time_under_a_load_like_the_observed_one(drive):
    end_s, forecasts = cutoff_s(drive), forecasting_pack()
    forecasts.run(drive[drive["time_s"] < end_s - 900.0])
    true_s = end_s - forecasts.forecaster.latest.time_s
    p05_s, median_s, p95_s = values_of(forecasts.forecaster.latest, *BAND)
    assert p05_s < true_s < p95_s
    assert median_s == pytest.approx(true_s, rel=0.35)
    assert values_of(forecasts.forecaster.latest, "cutoff_within_2min")[0] < 0.1
    assert 0.1 < values_of(forecasts.forecaster.latest, "cutoff_within_15min")[0] < 0.9


def test_the_curves_begin_at_the_present_state_and_end_at_the_cutoff(drive):
    forecasts = forecasting_pack()
    forecasts.run(drive[:5000])
    curve = forecasts.forecaster.latest.curve
    assert 30 <= curve.elapsed_s.size <= 60
    assert (np.diff(curve.elapsed_s) > 0.0).all()
    assert curve.soc_p50[0] == pytest.approx(forecasts.estimator.soc, abs=0.02)
    assert (curve.soc_p05 <= curve.soc_p50).all()
    assert (curve.soc_p50 <= curve.soc_p95).all()
    assert (curve.voltage_p05_v <= curve.voltage_p95_v).all()
    assert curve.survival[0] == 1.0
    assert curve.survival[-1] <= 0.05
    assert curve.voltage_p50_v[-1] == CUTOFF_V
    p95_s = values_of(forecasts.forecaster.latest, "time_to_cutoff_p95_s")[0]
    assert p95_s <= curve.elapsed_s[-1] * 1.05


def test_a_given_constant_current_gives_the_true_time_within_15_percent():
    block = constant_load(1.5, 8000)
    end_s, forecasts = cutoff_s(block), forecasting_pack()
    forecasts.run(block[:2000])
    now_s = forecasts.forecaster.latest.time_s
    given = forecasts.forecaster.forecast(GivenLoad(np.array([60.0]), np.array([1.5]), np.array([np.nan])))
    assert values_of(given, "time_to_cutoff_s")[0] == pytest.approx(end_s - now_s, rel=0.15)


def test_an_observed_constant_load_has_the_band_of_a_given_one():
    forecasts = forecasting_pack()
    forecasts.run(constant_load(1.5, 2000))
    given = forecasts.forecaster.forecast(GivenLoad(np.array([60.0]), np.array([1.5]), np.array([np.nan])))
    assert values_of(forecasts.forecaster.forecast(), *BAND) == pytest.approx(values_of(given, *BAND), rel=0.05)


def test_a_given_power_lasts_as_long_as_its_mean_current():
    forecasts = forecasting_pack()
    forecasts.run(constant_load(1.5, 2000))
    nan = np.array([np.nan])
    power = forecasts.forecaster.forecast(GivenLoad(np.array([60.0]), nan, np.array([5.0])))
    time_s, charge_ah = values_of(power, "time_to_cutoff_s", "usable_capacity_ah")
    mean_a = 3600.0 * charge_ah / time_s
    current = forecasts.forecaster.forecast(GivenLoad(np.array([60.0]), np.array([mean_a]), nan))
    assert time_s == pytest.approx(values_of(current, "time_to_cutoff_s")[0], rel=0.05)
    assert 3.2 < 5.0 / mean_a < 3.8


def test_a_power_that_the_pack_cannot_supply_reaches_the_cutoff_at_once():
    forecasts = forecasting_pack()
    forecasts.run(constant_load(1.5, 400))
    given = forecasts.forecaster.forecast(GivenLoad(np.array([60.0]), np.array([np.nan]), np.array([500.0])))
    assert values_of(given, *BAND) == [0.0, 0.0, 0.0]


def test_a_given_load_needs_no_observed_load_but_must_discharge():
    forecasts = forecasting_pack()
    forecasts.run(constant_load(0.0, 100))
    part = np.array([60.0, 60.0])
    discharge = forecasts.forecaster.forecast(GivenLoad(part, np.array([2.0, -0.5]), np.full(2, np.nan)))
    assert discharge.reason is None
    charge = forecasts.forecaster.forecast(GivenLoad(part, np.array([0.5, -2.0]), np.full(2, np.nan)))
    assert charge.reason == "the load does not discharge the pack on average"
    assert np.isnan(charge.values["time_to_cutoff_s"][0])


def test_a_low_load_lasts_for_its_mean_current():
    forecasts = forecasting_pack()
    forecasts.run(constant_load(0.05, 1000))
    median_s = values_of(forecasts.forecaster.latest, "time_to_cutoff_s")[0]
    assert median_s == pytest.approx(0.9 * TRUTH.cell.capacity_ah / 0.05 * 3600.0, rel=0.1)


def test_a_pack_in_series_may_end_earlier_by_its_weakest_cell():
    block = constant_load(1.5, 1000)
    cell = forecasting_pack()
    cell.run(block)
    pack_block = block.copy()
    pack_block["voltage_v"] *= 6.0
    estimator = Estimator(TRUTH.pack(6, 1), initial_soc=0.9)
    pack = Pack(estimator, forecaster=Forecaster(estimator, cutoff_v=6.0 * CUTOFF_V))
    pack.run(pack_block)
    assert pack.estimator.soc == pytest.approx(cell.estimator.soc, abs=0.01)
    ratios = np.divide(values_of(pack.forecaster.latest, *BAND), values_of(cell.forecaster.latest, *BAND))
    assert ratios[0] < 0.95
    assert 0.9 < ratios[1] < 1.0


def test_a_voltage_below_the_cutoff_ends_at_once():
    forecasts = forecasting_pack(cutoff_v=4.1)
    forecasts.run(constant_load(1.5, 400))
    assert values_of(forecasts.forecaster.latest, "time_to_cutoff_s", "cutoff_within_2min") == [
        pytest.approx(5.0, abs=5.0),
        1.0,
    ]


def test_the_reason_says_why_there_is_no_forecast():
    forecasts = forecasting_pack()
    assert forecasts.forecaster.latest.reason == "no sample has been processed yet"
    block = np.concatenate([constant_load(a, n) for a, n in ((1.0, 200), (1.0, 400), (0.0, 1000), (-1.0, 600))])
    block["time_s"] = np.arange(block.size)
    ends = 200, 600, 1600, 2200
    reasons = []
    for start, end in zip((0, *ends), ends, strict=False):
        forecasts.run(block[start:end])
        reasons.append(forecasts.forecaster.forecast().reason)
    assert reasons == [
        "less than 300 s of load have been seen since the last charge",
        None,
        "the pack has been at rest for 15 min",
        "the pack is being charged",
    ]


def test_a_clock_that_is_set_back_does_not_delay_the_next_forecast():
    forecasts, block = forecasting_pack(), constant_load(1.0, 1000)
    block["time_s"] += np.where(np.arange(block.size) < 500, 1e6, 0.0)
    forecasts.run(block)
    assert forecasts.forecaster.latest.time_s > 900.0
    assert forecasts.forecaster.latest.time_s < 1000.0


@pytest.mark.parametrize("time_s", [1e300, -1e300])
def test_a_time_stamp_whose_square_overflows_is_rejected(drive, time_s):
    block, forecasts = drive[:1500].copy(), forecasting_pack()
    block["time_s"][700] = time_s
    forecasts.run(block)
    assert forecasts.estimator.state["dropped_range"][0] == 1
    p05_s, median_s, p95_s = values_of(forecasts.forecaster.latest, *BAND)
    assert 0.0 < p05_s <= median_s <= p95_s < np.inf


@pytest.mark.parametrize(
    ("duration_s", "current_a"),
    [([3600.0], [1e-6]), ([1e-320], [1.0]), ([0.001, 0.001], [1.0, 0.5]), ([60.0, 60.0], [1.0, -0.9999])],
)
def test_the_cost_of_a_short_or_small_load_is_bounded(drive, monkeypatch, duration_s, current_a):
    steps = []
    simulate = projection.simulate_given_load

    def counted(m, parts, horizon_s, draws, *points):
        steps.append(draws.size * horizon_s / parts["duration_s"].mean())
        if steps[-1] < 1e7:
            simulate(m, parts, horizon_s, draws, *points)

    monkeypatch.setattr(projection, "simulate_given_load", counted)
    forecasts = forecasting_pack()
    forecasts.run(drive[:400])
    unknown = np.full(len(current_a), np.nan)
    forecasts.forecaster.forecast(GivenLoad(np.array(duration_s), np.array(current_a), unknown))
    assert max(steps) <= projection.MIN_DRAWS * projection.MAX_DRAW_STEPS * 1.01


def test_a_short_constant_load_repeats(drive):
    forecasts = forecasting_pack()
    forecasts.run(drive[:400])
    short, long = (
        forecasts.forecaster.forecast(GivenLoad(np.array([duration_s]), np.array([1.5]), np.array([np.nan])))
        for duration_s in (0.5, 3600.0)
    )
    assert values_of(short, *BAND) == pytest.approx(values_of(long, *BAND), rel=1e-6)
