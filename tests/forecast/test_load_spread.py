"""Spread of the mean future load: wide after few different trips, narrow after a long homogeneous load."""

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy import stats

from bms_estimator.forecast.load_history import load_spread
from bms_estimator.kernels.forecast.draws import DRAW, MAX_LOAD_FACTOR, draw_load_factors
from tests.estimator.simulated_cell import measured
from tests.forecast.simulated_load import forecasting_pack

TRIP_S, LEVEL_S = 1200, 20


def trip(mean_a: float, seed: int = 1) -> np.ndarray:
    """Return the current of each second of a trip with random levels around a mean [A]."""
    levels = np.random.default_rng(seed).uniform(0.0, 2.0, TRIP_S // LEVEL_S)
    return np.repeat(mean_a * levels / levels.mean(), LEVEL_S)


def trips(*means_a: float) -> np.ndarray:
    """Return trips that differ only in their mean [A]."""
    return np.concatenate([trip(mean_a) for mean_a in means_a])


@given(st.floats(0.1, 2.0), st.floats(1.5, 10.0))
def test_two_trips_of_different_mean_have_a_wider_spread_than_one_repeated(mean_a, ratio):
    repeated = load_spread(trips(mean_a, mean_a))
    different = load_spread(trips(mean_a, ratio * mean_a))
    assert different.std > repeated.std


@given(st.integers(1, 12), st.integers(1, 4))
def test_more_repetitions_of_a_trip_narrow_the_spread(count, more):
    few, many = (load_spread(trips(*[1.0] * n)) for n in (count, count + more))
    assert many.std < few.std
    assert many.degrees >= few.degrees


@given(st.floats(0.1, 10.0), st.integers(300, 4000))
def test_a_constant_load_has_no_spread(current_a, seconds):
    assert load_spread(np.full(seconds, current_a)).std == pytest.approx(0.0, abs=1e-6)


@given(st.floats(0.01, 100.0))
def test_the_unit_of_the_current_does_not_matter(factor):
    load = trips(1.0, 1.6, 0.8)
    assert load_spread(factor * load).std == pytest.approx(load_spread(load).std)


def test_the_spread_contains_most_differences_between_observed_and_future_trips():
    rng = np.random.default_rng(1)
    inside = []
    for _ in range(400):
        means_a = rng.uniform(0.5, 1.5, 16)
        observed, future = trips(*means_a[:4]), trips(*means_a[4:])
        spread = load_spread(observed)
        limit = spread.std * stats.t.ppf(0.95, spread.degrees)
        inside.append(abs(np.log(future.mean() / observed.mean())) <= limit)
    assert 0.7 < np.mean(inside) < 0.95


def test_load_factors_have_the_quantiles_of_students_t_distribution():
    draws = np.zeros(20_000, DRAW)
    draws["first_generator"] = np.random.default_rng(1).integers(2**63, size=draws.size)
    draw_load_factors(0.2, 3.0, draws)
    levels = np.array([0.05, 0.25, 0.5, 0.75, 0.95])
    assert np.quantile(np.log(draws["load_factor"]), levels) == pytest.approx(0.2 * stats.t.ppf(levels, 3.0), abs=0.02)
    assert draws["load_factor"].max() == pytest.approx(MAX_LOAD_FACTOR)


def test_the_band_is_wider_after_two_different_trips_than_after_one_repeated_trip():
    bands = []
    for means_a in ((0.8, 0.8), (0.4, 1.2)):
        forecasting = forecasting_pack()
        forecasting.run(measured(trips(*means_a), 0.9, np.random.default_rng(1))[0])
        values = forecasting.forecaster.forecast().values
        bands.append(np.log(values["time_to_cutoff_p95_s"] / values["time_to_cutoff_p05_s"]).item())
    assert bands[1] > 1.2 * bands[0]
