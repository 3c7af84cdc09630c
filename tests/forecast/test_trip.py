"""Trips: loads that a user gives, and their outcome."""

import re

import numpy as np
import pytest

from bms_estimator.estimator.estimator import compiled_estimator
from bms_estimator.forecast.forecaster import Forecaster
from bms_estimator.forecast.trip import MAX_TRIP_S, TripOutcome, constant_trip, profile_trip, trip_outcome
from bms_estimator.model.arrays import SAMPLE
from bms_estimator.model.cell import load_cell
from bms_estimator.model.errors import UserError
from bms_estimator.pack.pack import Pack
from bms_estimator.settings.pack import PackSettings, Settings

CELL = load_cell("ncr18650")
CUTOFF_V = 2.8


def array(*values: float) -> np.ndarray:
    return np.array(values)


@pytest.fixture(scope="module")
def forecaster() -> Forecaster:
    """Return the forecaster of a cell at rest at SOC 0.5."""
    estimator = compiled_estimator(Settings(pack=PackSettings(initial_soc=0.5)), CELL)
    forecaster = Forecaster(estimator, cutoff_v=CUTOFF_V)
    samples = np.zeros(60, SAMPLE)
    samples["time_s"], samples["voltage_v"], samples["temperature_c"] = np.arange(60), 3.62, 25.0
    Pack(estimator, forecaster=forecaster).run(samples)
    return forecaster


def outcome_of(forecaster: Forecaster, current_a: float, duration_s: float) -> TripOutcome:
    trip = constant_trip("current_a", current_a, duration_s)
    curve = forecaster.given_load_curve(trip.load)
    assert curve
    return trip_outcome(trip, curve)


def test_short_trip_has_enough_charge_and_ends_at_the_charge_that_it_draws(forecaster: Forecaster) -> None:
    outcome = outcome_of(forecaster, 1.5, 600.0)
    drawn = 1.5 * 600.0 / 3600.0 / CELL.cell.capacity_ah
    assert (outcome.verdict, outcome.enough_probability) == ("enough", 1.0)
    assert outcome.soc_p50 == pytest.approx(forecaster.estimator.soc - drawn, abs=0.02)
    assert outcome.soc_p05 < outcome.soc_p50 < outcome.soc_p95
    assert CUTOFF_V < outcome.voltage_p05_v < outcome.voltage_p50_v < outcome.voltage_p95_v < 3.62
    assert outcome.energy_wh == pytest.approx(0.25 * 3.5, rel=0.05)


def test_long_trip_does_not_have_enough_charge(forecaster: Forecaster) -> None:
    outcome = outcome_of(forecaster, 1.5, 4.0 * 3600.0)
    assert (outcome.verdict, outcome.enough_probability) == ("not enough", 0.0)
    assert outcome.voltage_p50_v == CUTOFF_V


def test_trip_that_ends_at_the_median_of_the_time_to_cutoff_is_uncertain(forecaster: Forecaster) -> None:
    forecast = forecaster.forecast(constant_trip("current_a", 1.5).load)
    outcome = outcome_of(forecaster, 1.5, float(forecast.values[0]["time_to_cutoff_s"]))
    assert outcome.verdict == "uncertain"
    assert outcome.enough_probability == pytest.approx(0.5, abs=0.05)


def test_profile_keeps_each_load_until_the_next_point() -> None:
    load = profile_trip("power_w", array(10.0, 70.0, 100.0), array(50.0, 0.0, 999.0)).load
    assert load.duration_s.tolist() == [60.0, 30.0]
    assert load.power_w.tolist() == [50.0, 0.0]
    assert np.isnan(load.current_a).all()


@pytest.mark.parametrize(
    ("time_s", "values", "text"),
    [
        ([0.0], [1.0], "1 points: must be 2 to"),
        ([0.0, 5.0, 5.0], [1.0, 1.0, 1.0], "point 3: time_s = 5 after 5: must increase"),
        ([0.0, -5.0], [1.0, 1.0], "point 2: time_s = -5 after 0: must increase"),
        ([0.0, np.nan], [1.0, 1.0], "point 2: time_s = nan after 0: must increase"),
        ([0.0, 2.0 * MAX_TRIP_S], [1.0, 1.0], "must be at most 604800 s"),
        ([0.0, 1.0, 2.0], [1.0, np.nan, 1.0], "point 2: power_w = nan: must be a number"),
        ([0.0, 1.0], [-1e7, 1.0], "point 1: power_w = -1e+07: must be a number"),
    ],
)
def test_invalid_profile_is_rejected_with_its_point(time_s: list[float], values: list[float], text: str) -> None:
    with pytest.raises(UserError, match=re.escape(text)):
        profile_trip("power_w", array(*time_s), array(*values))


@pytest.mark.parametrize("duration_s", [0.0, -1.0, 2.0 * MAX_TRIP_S, float("nan")])
def test_constant_load_needs_a_positive_duration(duration_s: float) -> None:
    with pytest.raises(UserError, match="duration_s = "):
        constant_trip("power_w", 5.0, duration_s)
