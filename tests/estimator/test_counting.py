"""Learned capacity and learned offset of the current sensor, and their std, on cells that differ from the model.

The error of the OCV limits the accuracy of a capacity. The cell files have half of the typical OCV error, 2 mV and 0.35 % of
SOC, as from a slow discharge of the cell itself.
"""

from collections.abc import Sequence

import numpy as np
import pytest
from scipy.stats import chi2

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.estimator.identified_parameters import IdentifiedValue, current_offset, relative_capacity
from bms_estimator.kernels.kalman_filter.records import LN_Q
from bms_estimator.pack.pack import Pack
from bms_estimator.pack_model.slow_fit import SlowFit
from tests.estimator.anywhere.cases import Capture, Case, capture
from tests.estimator.anywhere.use import DAY_S, cycles, days
from tests.fit_interval import fits_every

SEEDS = range(1, 9)
FEW_SEEDS = SEEDS[:2]
"""Seeds of the shorter tests. Tests with the mark ``thorough`` use all of ``SEEDS``."""
OWN_CURVE = {"file_ocv_error_ratio": 0.5, "load_before_h": 0.0}
"""Half of the typical OCV error, and no load before the estimator starts."""
FIT_INTERVAL_S = 3.0 * 3600.0
"""Interval between two slow fits [s]."""
MAX_CAPACITY_ERROR = 0.025
"""Limit of the relative error of the capacity of each cell."""
MAX_RMS_CAPACITY_ERROR = 0.015
"""Limit of the RMS of the relative error of the capacity over all cells."""
MAX_OFFSET_ERROR_A = 0.003
"""Limit of the error of an offset after a day, in cells of 3 Ah [A]."""
MAX_OFFSET_STD_A = 0.006
"""Limit of the std of an offset after a day, in cells of 3 Ah [A]."""


def error_over_std(learned: IdentifiedValue, true_value: float) -> float:
    """Return the error of a learned value divided by its std."""
    return (learned.value - true_value) / learned.std


def estimate_cycles(case: Case, initial_soc_error: float) -> Estimator:
    """Return the estimator after three cycles between SOC 0.9 and 0.2 with rests of 10 min, with the slow fit."""
    rng = np.random.default_rng(case.seed)
    recording = capture(case, cycles(rng, case.truth.capacity_ah, count=3, by_soc=0.7, rest_s=600))
    estimator = Estimator(recording.cell, initial_soc=float(np.clip(recording.soc[0] + initial_soc_error, 0.0, 1.0)))
    with fits_every(FIT_INTERVAL_S):
        Pack(estimator, SlowFit(estimator, interval_s=FIT_INTERVAL_S)).run(recording.samples)
    return estimator


def simulate_use(case: Case, count: int) -> Capture:
    """Simulate ``count`` days of mixed use with rests."""
    rng = np.random.default_rng(case.seed)
    return capture(case, days(rng, case.truth.capacity_ah, count, case.soc))


@pytest.mark.parametrize(
    ("initial_soc_error", "seeds"),
    [
        pytest.param(0.0, SEEDS, marks=pytest.mark.thorough),
        pytest.param(-0.2, SEEDS, marks=pytest.mark.thorough),
        (-0.2, FEW_SEEDS),
    ],
)
def test_a_capacity_wrong_by_20_percent_is_corrected_after_three_cycles(
    initial_soc_error: float, seeds: Sequence[int]
) -> None:
    errors, errors_over_std = [], []
    for seed in seeds:
        for capacity_ratio in (0.8, 1.2):
            case = Case("cycles", file_capacity_ratio=capacity_ratio, seed=seed, **OWN_CURVE)
            # the true capacity divided by the capacity in the file is 1 / capacity_ratio
            learned = relative_capacity(estimate_cycles(case, initial_soc_error).record[0])
            errors.append(capacity_ratio * learned.value - 1.0)
            errors_over_std.append(error_over_std(learned, 1.0 / capacity_ratio))
    assert np.abs(errors).max() < MAX_CAPACITY_ERROR
    assert np.sqrt(np.mean(np.square(errors))) < MAX_RMS_CAPACITY_ERROR
    # Both runs of a seed have the same error of the OCV, so that they are one degree of freedom.
    # With a correct std, 1 of 1000 draws exceeds the limit.
    assert np.mean(np.square(errors_over_std)) < chi2.ppf(0.999, len(seeds)) / len(seeds)


def test_a_gain_error_of_the_current_sensor_is_learned_as_a_capacity() -> None:
    """A current sensor with a gain of 1.05 leads to a capacity that is 1.05 times as large.

    Currents and capacity 1.05 times as large, with resistances divided by 1.05, give equal voltages. Therefore data cannot
    distinguish a gain error from a capacity.
    """
    errors = []
    for seed in FEW_SEEDS:
        estimator = estimate_cycles(
            Case("gain", current_gain=1.05, file_capacity_ratio=1.0, seed=seed, **OWN_CURVE), 0.0
        )
        errors.append(relative_capacity(estimator.record[0]).value / 1.05 - 1.0)
    assert np.sqrt(np.mean(np.square(errors))) < MAX_RMS_CAPACITY_ERROR


@pytest.mark.parametrize(
    ("temperature_c", "seeds"),
    [
        (25.0, FEW_SEEDS),
        pytest.param(25.0, SEEDS, marks=pytest.mark.thorough),
        pytest.param(0.0, SEEDS, marks=pytest.mark.thorough),
    ],
)
def test_an_offset_of_20_ma_is_identified_within_a_day(temperature_c: float, seeds: Sequence[int]) -> None:
    errors_over_std = []
    for seed in seeds:
        offset_a = 0.02 if seed % 2 else -0.02
        parameters = {"file_capacity_ratio": 1.1, "offset_a": offset_a, "temperature_c": temperature_c}
        recording = simulate_use(Case("offset", soc=0.8, seed=seed, **parameters, **OWN_CURVE), count=1)
        estimator = Estimator(recording.cell, initial_soc=0.8)
        estimator.run(recording.samples)
        learned = current_offset(estimator.record[0])
        assert abs(learned.value - offset_a) < MAX_OFFSET_ERROR_A
        assert learned.std < MAX_OFFSET_STD_A
        errors_over_std.append(error_over_std(learned, offset_a))
    assert np.mean(np.square(errors_over_std)) < 1.0


def test_an_offset_that_changes_after_days_is_identified_again() -> None:
    recording = simulate_use(Case("step", soc=0.8, **OWN_CURVE), count=6)
    first_with_offset, offset_a = 4 * DAY_S, 0.03
    recording.samples["current_a"][first_with_offset:] += offset_a
    estimator = Estimator(recording.cell, initial_soc=0.8)
    estimator.run(recording.samples[:first_with_offset])
    before = current_offset(estimator.record[0])
    trace = estimator.run(recording.samples[first_with_offset:])
    after = current_offset(estimator.record[0])
    assert abs(before.value) < MAX_OFFSET_ERROR_A
    assert abs(after.value - offset_a) < MAX_OFFSET_ERROR_A
    inside = np.abs(trace["soc"] - recording.soc[first_with_offset:]) < 2.0 * trace["soc_std"]
    assert inside[DAY_S:].mean() > 0.95  # a day after the change


def test_self_discharge_is_identified_as_an_offset() -> None:
    """Self-discharge of 10 % a month is a constant unmeasured current, like an offset of the sensor."""
    capacity_ah, month_h = 3.0, 30.0 * 24.0
    drain_a = 0.1 * capacity_ah / month_h
    case = Case("self-discharge", soc=0.8, offset_a=-drain_a, **OWN_CURVE)
    recording = capture(case, np.full(4 * DAY_S, drain_a))
    estimator = Estimator(recording.cell, initial_soc=0.8)
    estimator.run(recording.samples)
    learned = current_offset(estimator.record[0])
    assert abs(learned.value + drain_a) < 1e-4
    assert abs(error_over_std(learned, -drain_a)) < 1.0


def test_the_std_of_a_learned_value_includes_the_spread_of_the_hypotheses() -> None:
    case = Case("start", **OWN_CURVE)
    recording = capture(case, np.zeros(60))
    estimator = Estimator(recording.cell, initial_soc=0.5)
    estimator.run(recording.samples[:1])
    f = estimator.record[0]["filter"]
    assert f["count"] > 1
    std_with_equal_means = relative_capacity(estimator.record[0]).std
    f["mean"][: f["count"], LN_Q] = np.linspace(-0.1, 0.1, f["count"])
    assert relative_capacity(estimator.record[0]).std > std_with_equal_means
