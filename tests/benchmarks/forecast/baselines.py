"""Other forecasts of the time to the cut-off, and the loads that they expect."""

import math
from typing import NamedTuple

import numpy as np

from bms_estimator.estimator.identified_parameters import relative_capacity
from bms_estimator.forecast.forecast import Forecast
from bms_estimator.forecast.given_load import GivenLoad
from bms_estimator.model.sample import SampleBlock
from tests.benchmarks.forecast.moments import Moment, last
from tests.benchmarks.recipes import charge_ah

MEAN_CURRENT_S, REPEATED_S = 600.0, 1800.0
"""Durations of the mean current, and of the load that is repeated [s]."""
CONSTANT_S = 3600.0
"""Duration of a part of a constant load [s]. The forecast divides it into steps."""
MAX_STEPS = 14_400
"""Maximum number of steps in which a repeated load empties the pack. A small load is given in steps of more than a second."""
NORMAL_95 = 1.645
"""95 % quantile of the standard normal distribution."""


class Quantiles(NamedTuple):
    """Quantiles of the time to the cut-off [s]; NaN if unknown."""

    p05_s: float
    p50_s: float
    p95_s: float


UNKNOWN = Quantiles(math.nan, math.nan, math.nan)


def quantiles_of(forecast: Forecast) -> Quantiles:
    """Return the quantiles of a forecast."""
    values = forecast.values[0]
    return Quantiles(*(float(values[f"time_to_cutoff{name}_s"]) for name in ("_p05", "", "_p95")))


def charge_over_mean_current(moment: Moment) -> Quantiles:
    """Return the charge to SOC 0 over the mean current of ten minutes, with the std of the SOC as the only spread."""
    mean_a = mean_current(last(moment.samples, MEAN_CURRENT_S))
    estimator = moment.forecaster.estimator
    if not mean_a > 0.0:
        return UNKNOWN
    capacity_as = float(estimator.settings[0]["capacity_as"]) * relative_capacity(estimator.record[0]).value
    soc = estimator.soc + NORMAL_95 * estimator.soc_std * np.array([-1.0, 0.0, 1.0])
    return Quantiles(*(np.maximum(soc, 0.0) * capacity_as / mean_a).tolist())


def half_hour_repeated(moment: Moment) -> Quantiles:
    """Return the forecast of the model under the load of the last half hour, repeated."""
    recent, estimator = last(moment.samples, REPEATED_S), moment.forecaster.estimator
    charge_as = estimator.soc * float(estimator.settings[0]["capacity_as"])
    step_s = math.ceil(charge_as / max(mean_current(recent), 1e-6) / MAX_STEPS)
    if not 1 <= step_s <= REPEATED_S:
        return UNKNOWN
    return under_load(moment, load_by_second(recent, float(recent["time_s"][0]), moment.time_s, step_s))


def constant_power(moment: Moment) -> Quantiles:
    """Return the median of the model under the mean power of ten minutes, without a band."""
    recent = last(moment.samples, MEAN_CURRENT_S)
    steps_s = np.diff(recent["time_s"])
    power_w = float(np.sum((recent["current_a"] * recent["voltage_v"])[:-1] * steps_s) / max(np.sum(steps_s), 1.0))
    if not power_w > 0.0:
        return UNKNOWN
    median_s = under_load(moment, GivenLoad(np.array([CONSTANT_S]), np.array([math.nan]), np.array([power_w]))).p50_s
    return Quantiles(median_s, median_s, median_s)


def true_load_given(moment: Moment, samples: SampleBlock) -> Quantiles:
    """Return the forecast of the model under the true load, after whose end its last half hour repeats.

    Args:
        moment: Moment of the forecast.
        samples: Samples of the discharge, also after the cut-off.
    """
    end_s = float(samples["time_s"][-1])
    true_load = load_by_second(samples, moment.time_s, end_s)
    last_load = load_by_second(samples, end_s - REPEATED_S, end_s)
    if true_load is None or last_load is None:
        return UNKNOWN
    repeats = 1 + int(moment.left_s / REPEATED_S)
    current_a = np.concatenate([true_load.current_a, *[last_load.current_a] * repeats])
    return under_load(moment, GivenLoad(np.ones(current_a.size), current_a, np.full(current_a.size, math.nan)))


def drawn_truth(moment: Moment, by_true_load: Quantiles) -> float:
    """Return a time to the cut-off that the model draws under the true load [s].

    The draw is a two-sided normal distribution through the quantiles. Its random number depends on the moment alone.
    """
    normal = float(np.random.default_rng(round(moment.time_s)).standard_normal())
    outer_s = by_true_load.p95_s if normal > 0.0 else by_true_load.p05_s
    return by_true_load.p50_s + abs(normal) / NORMAL_95 * (outer_s - by_true_load.p50_s)


def under_load(moment: Moment, load: GivenLoad | None) -> Quantiles:
    """Return the forecast of the model under a load; unknown without a load that discharges the pack."""
    if load is None or not (np.any(load.current_a > 0.0) or np.any(load.power_w > 0.0)):
        return UNKNOWN
    return quantiles_of(moment.forecaster.forecast(load))


def load_by_second(samples: SampleBlock, begin_s: float, end_s: float, step_s: int = 1) -> GivenLoad | None:
    """Return the mean current of each ``step_s`` from ``begin_s`` to ``end_s`` [s]; None if that is less than a step."""
    edges_s = np.arange(begin_s, end_s + 0.5, step_s)
    if edges_s.size < 2:
        return None
    time_s = np.maximum.accumulate(samples["time_s"])
    current_a = 3600.0 * np.diff(np.interp(edges_s, time_s, charge_ah(samples))) / step_s
    return GivenLoad(np.full(current_a.size, float(step_s)), current_a, np.full(current_a.size, math.nan))


def mean_current(samples: SampleBlock) -> float:
    """Return the mean current over the time of the samples [A]."""
    duration_s = float(samples["time_s"][-1] - samples["time_s"][0])
    return 3600.0 * float(charge_ah(samples)[-1]) / duration_s if duration_s > 0.0 else float(samples["current_a"][-1])
