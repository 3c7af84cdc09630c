"""Learned capacity and offset of the current sensor, and their std, on cells that differ from the model.

The cell files have half of the typical OCV error, 2 mV and 0.35 % of SOC, as from a slow discharge of the cell itself. The
error of the OCV limits the accuracy of a capacity.
"""

import numpy as np
import pytest
from scipy.stats import chi2

from bms_estimator.estimator import Estimator
from bms_estimator.estimator.identified_parameters import IdentifiedValue, current_offset, relative_capacity
from bms_estimator.kernels.kalman_filter.records import LN_Q
from tests.estimator.anywhere.cases import Capture, Case, capture
from tests.estimator.anywhere.use import DAY_S, cycles, days

SEEDS = range(1, 9)
OWN_CURVE = {"curve_error": 0.5, "unseen_h": 0.0}
MAX_ERROR, SOH_ERROR = 0.025, 0.015
"""Limits of the relative capacity error: maximum over 16 cells, and RMS."""
MAX_A, MAX_STD_A = 0.003, 0.006
"""Limits of the error and std of an offset after a day, in cells of 3 Ah [A]."""


def nees_limit(cells: int) -> float:
    """Return the limit of the mean of (error / std)^2 over this number of cells, which the true std exceeds in 1 of
    1000 draws."""
    return float(chi2.ppf(0.999, cells)) / cells


def ratio(learned: IdentifiedValue, true: float) -> float:
    """Return the error over the std."""
    return (learned.value - true) / learned.std


def after_cycles(case: Case, told_wrong: float) -> Estimator:
    """Return the estimator after three cycles between 0.9 and 0.2 with rests of 10 min, with a wrong initial SOC."""
    rng = np.random.default_rng(case.seed)
    seen = capture(case, cycles(rng, case.truth.capacity_ah, count=3, by_soc=0.7, rest_s=600))
    estimator = Estimator(seen.cell, initial_soc=float(np.clip(seen.soc[0] + told_wrong, 0.0, 1.0)))
    estimator.run(seen.samples)
    return estimator


def in_use(case: Case, count: int) -> Capture:
    """Return the estimator after days of mixed use with rests."""
    rng = np.random.default_rng(case.seed)
    return capture(case, days(rng, case.truth.capacity_ah, count, case.soc))


@pytest.mark.parametrize("told_wrong", [pytest.param(0.0, marks=pytest.mark.thorough), -0.2])
def test_a_capacity_wrong_by_20_percent_is_corrected_after_three_cycles(told_wrong: float) -> None:
    errors, ratios = [], []
    for seed in SEEDS:
        for told in (0.8, 1.2):
            case = Case("cycles", capacity=told, seed=seed, **OWN_CURVE)
            learned = relative_capacity(after_cycles(case, told_wrong).record[0])
            errors.append(told * learned.value - 1.0)
            ratios.append(ratio(learned, 1.0 / told))
    assert np.abs(errors).max() < MAX_ERROR
    assert np.sqrt(np.mean(np.square(errors))) < SOH_ERROR
    assert np.mean(np.square(ratios)) < nees_limit(len(SEEDS))  # both runs of a seed have equal curves and count once


def test_a_gain_error_of_the_current_sensor_is_equivalent_to_a_capacity() -> None:
    """Currents and capacity 1.05 times as large and resistances 1/1.05 times give equal voltages, so that data cannot
    distinguish a gain error from a capacity."""
    errors = []
    for seed in SEEDS:
        estimator = after_cycles(Case("gain", gain=1.05, capacity=1.0, seed=seed, **OWN_CURVE), 0.0)
        errors.append(relative_capacity(estimator.record[0]).value / 1.05 - 1.0)
    assert np.sqrt(np.mean(np.square(errors))) < SOH_ERROR


@pytest.mark.parametrize("temperature_c", [25.0, 0.0])
def test_an_offset_of_20_ma_is_identified_within_a_day(temperature_c: float) -> None:
    ratios = []
    for seed in SEEDS:
        offset_a = 0.02 if seed % 2 else -0.02
        told = {"capacity": 1.1, "offset_a": offset_a, "temperature_c": temperature_c}
        seen = in_use(Case("offset", soc=0.8, seed=seed, **told, **OWN_CURVE), 1)
        estimator = Estimator(seen.cell, initial_soc=0.8)
        estimator.run(seen.samples)
        learned = current_offset(estimator.record[0])
        assert abs(learned.value - offset_a) < MAX_A
        assert learned.std < MAX_STD_A
        ratios.append(ratio(learned, offset_a))
    assert np.mean(np.square(ratios)) < 1.0


def test_an_offset_that_changes_after_days_is_identified_again() -> None:
    seen = in_use(Case("step", soc=0.8, **OWN_CURVE), 6)
    change = 4 * DAY_S
    seen.samples["current_a"][change:] += 0.03
    estimator = Estimator(seen.cell, initial_soc=0.8)
    estimator.run(seen.samples[:change])
    before = current_offset(estimator.record[0])
    trace = estimator.run(seen.samples[change:])
    after = current_offset(estimator.record[0])
    assert abs(before.value) < MAX_A
    assert abs(after.value - 0.03) < MAX_A
    inside = np.abs(trace["soc"] - seen.soc[change:]) < 2.0 * trace["soc_std"]
    assert inside[DAY_S:].mean() > 0.95


def test_self_discharge_is_identified_as_an_offset() -> None:
    """Self-discharge of 10 % a month is a constant unmeasured current, like an offset of the sensor."""
    drain_a = 0.1 * 3.0 / 30.0 / 24.0
    case = Case("self-discharge", soc=0.8, offset_a=-drain_a, **OWN_CURVE)
    seen = capture(case, np.full(4 * DAY_S, drain_a))
    estimator = Estimator(seen.cell, initial_soc=0.8)
    estimator.run(seen.samples)
    learned = current_offset(estimator.record[0])
    assert abs(learned.value + drain_a) < 1e-4
    assert abs(ratio(learned, -drain_a)) < 1.0


def test_the_std_of_a_learned_value_is_that_of_the_mixture() -> None:
    case = Case("start", **OWN_CURVE)
    seen = capture(case, np.zeros(60))
    estimator = Estimator(seen.cell, initial_soc=0.5)
    estimator.run(seen.samples[:1])
    f = estimator.record[0]["filter"]
    assert f["count"] > 1
    alone = relative_capacity(estimator.record[0]).std
    f["mean"][: f["count"], LN_Q] = np.linspace(-0.1, 0.1, f["count"])
    both = relative_capacity(estimator.record[0]).std
    assert both > alone
