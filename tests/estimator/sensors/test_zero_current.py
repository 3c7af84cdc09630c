"""Samples that report no current determine the offset of the current sensor, except in some cases."""

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.kernels.kalman_filter import ekf
from bms_estimator.kernels.kalman_filter.records import EKF_SETTINGS, EKF_STATE, OFFSET, SOC, STATES
from bms_estimator.model.arrays import SAMPLE
from bms_estimator.model.cell import load_cell
from bms_estimator.settings.observer import IdentifierSettings, Sampling
from tests.estimator.anywhere.cases import LFP, Case, capture, load_a
from tests.estimator.anywhere.score import score

CAPACITY_AH = 3.0
INITIAL_STD_A, ZERO_STD_A = 0.007 * CAPACITY_AH, 0.001 * CAPACITY_AH
"""Std of the offset at the start, and std of the information from samples without current [A]."""
SMALLEST_A = 0.002
"""Smallest current that the sensor reports during the load [A]. It limits the assumed resolution."""


def offset_after(reported_a, sampling=None, smallest_a=SMALLEST_A):
    """Run an estimator over ten minutes of load and two minutes in which the sensor reports ``reported_a``.

    During the load the sensor reports ``smallest_a`` for 20 s. Return the offset and its std [A].
    """
    rng = np.random.default_rng(1)
    samples = np.zeros(720, dtype=SAMPLE)
    samples["time_s"] = np.arange(720.0)
    samples["current_a"][:600] = np.repeat(rng.uniform(1.0, 3.0, 30), 20)
    samples["current_a"][300:320] = smallest_a
    samples["current_a"][600:] = reported_a
    samples["voltage_v"], samples["temperature_c"] = 3.7 - 0.03 * samples["current_a"], 25.0
    options = {} if sampling is None else {"sampling": sampling}
    estimator = Estimator(load_cell("nmc", CAPACITY_AH), initial_soc=0.6, **options)
    return run_and_get_offset(estimator, samples)


def run_and_get_offset(estimator, samples):
    """Run the estimator over the samples; return the offset and its std [A]."""
    estimator.run(samples)
    f = estimator.record[0]["filter"]
    return f["mean"][f["best"], OFFSET], np.sqrt(f["covariance"][f["best"], OFFSET, OFFSET])


def test_a_sensor_that_reports_no_current_at_rest_has_no_offset() -> None:
    offset_a, std_a = offset_after(0.0)
    assert abs(offset_a) < 1e-3
    assert ZERO_STD_A <= std_a < 1.2 * ZERO_STD_A


def test_a_zero_current_with_noise_determines_the_offset() -> None:
    noise_a = np.random.default_rng(2).normal(0.0, 5e-3, 120)
    offset_a, std_a = offset_after(noise_a, smallest_a=1.0)
    assert abs(offset_a) < 2e-3
    assert std_a < 1.2 * ZERO_STD_A


@pytest.mark.parametrize(
    "arguments",
    [
        {"reported_a": 0.05},
        {"reported_a": -0.05},
        {"reported_a": 0.02},
        {"reported_a": 0.0, "smallest_a": 0.3},
        {"reported_a": 0.0, "sampling": Sampling(1.0, current_dead_band_a=0.5)},
        {"reported_a": 0.0, "sampling": Sampling(1.0, current_resolution_a=0.1)},
    ],
    ids=["50 mA", "-50 mA", "20 mA", "unknown resolution", "dead band", "coarse steps"],
)
def test_a_possible_load_or_hidden_current_gives_no_information(arguments) -> None:
    assert offset_after(**arguments)[1] > 0.7 * INITIAL_STD_A


LOAD = (100, 1.0, 1), (20, SMALLEST_A, 1), (100, 1.0, 1)
"""Load with a small current, as steps of (duration [s], current [A], sample period [s])."""


def offset_after_steps(steps, estimator=None):
    """Run the estimator over steps of duration [s], current [A] and sample period [s]; return offset and its std [A].

    Without ``estimator``, a new one is run over ``LOAD`` first.
    """
    steps = [*LOAD, *steps] if estimator is None else steps
    estimator = estimator or Estimator(load_cell("nmc", CAPACITY_AH), initial_soc=0.6)
    time_s, times, currents = 0.0, [], []
    for duration_s, current_a, step_s in steps:
        for _ in range(round(duration_s / step_s)):
            time_s += step_s
            times.append(time_s)
            currents.append(current_a)
    samples = np.zeros(len(times), dtype=SAMPLE)
    samples["time_s"], samples["current_a"] = times, currents
    samples["voltage_v"], samples["temperature_c"] = 3.7 - 0.03 * samples["current_a"], 25.0
    return run_and_get_offset(estimator, samples)


def test_samples_of_both_signs_are_no_rest() -> None:
    """The mean of samples a minute apart is zero, as under changing clouds, but no sample reports zero."""
    alternating = [(60, current_a, 60) for current_a in (2.0, -2.0) * 10]
    assert offset_after_steps(alternating)[1] > 0.7 * INITIAL_STD_A


def test_a_single_small_sample_does_not_determine_the_resolution() -> None:
    """A single small value may be a mean over a current step. ``LOAD`` has 20 successive ones, which are a current."""
    single_small_sample = [(100, 1.0, 1), (1, SMALLEST_A, 1), (100, 1.0, 1), (120, 0.0, 1)]
    estimators = [Estimator(load_cell("nmc", CAPACITY_AH), initial_soc=0.6) for _ in range(2)]
    assert offset_after_steps(single_small_sample, estimators[0])[1] > 0.7 * INITIAL_STD_A
    assert offset_after_steps([*LOAD, *single_small_sample], estimators[1])[1] < 1.2 * ZERO_STD_A


@pytest.mark.parametrize("later_steps", [(), LOAD], ids=["no small current", "small current again"])
def test_the_resolution_is_determined_again_after_a_restart(later_steps) -> None:
    estimator = Estimator(load_cell("nmc", CAPACITY_AH), initial_soc=0.6)
    offset_after_steps([*LOAD, (50, 0.0, 1)], estimator)
    estimator.resume(3600.0)
    std_a = offset_after_steps([*later_steps, (130, 0.0, 1)], estimator)[1]
    if later_steps:
        assert std_a < 1.2 * ZERO_STD_A
    else:
        assert std_a > 0.7 * INITIAL_STD_A


def test_a_small_load_after_a_long_rest_is_not_averaged_with_the_rest() -> None:
    """Hours of zero current before the load do not reduce its mean: the smallest load, C/150, is no offset."""
    assert abs(offset_after_steps([(7200, 0.0, 1), (3600, 0.02, 1)])[0]) < 2e-3


def test_a_constant_small_load_stays_in_the_interval() -> None:
    """An LFP cell on its plateau is discharged with C/600 for a day.

    The std covers that this current may be an offset.
    """
    hours, capacity_ah = 24.0, 100.0
    samples = np.zeros(round(3600.0 * hours) // 10, dtype=SAMPLE)
    samples["time_s"] = 10.0 * np.arange(samples.size)
    samples["current_a"] = capacity_ah / 600.0
    samples["current_a"][:60] = np.repeat([50.0, 0.1, 20.0], 20)  # a load that shows a resolution of 0.1 A
    samples["voltage_v"], samples["temperature_c"] = 3.29, 25.0
    estimator = Estimator(load_cell("lfp", capacity_ah), identifier=IdentifierSettings(soc_std=0.01), initial_soc=0.6)
    trace = estimator.run(samples)
    discharged = np.cumsum(samples["current_a"]) * 10.0 / 3600.0 / capacity_ah
    assert (np.abs(trace["soc"] - (0.6 - discharged)) < 2.0 * trace["soc_std"])[60:].all()


def test_a_direct_update_of_a_state_equals_the_kalman_update() -> None:
    rng = np.random.default_rng(3)
    s, p = np.zeros(1, EKF_STATE)[0], np.zeros(1, EKF_SETTINGS)[0]
    p["learning_soc"] = 1.0
    root = rng.standard_normal((STATES, STATES))
    before, mean = root @ root.T, rng.standard_normal(STATES)
    mean[SOC] = 0.5
    s["covariance"][0], s["mean"][0] = before, mean
    innovation, variance = 0.01, 0.3
    ekf.update_state_directly(s, p, 0, OFFSET, mean[OFFSET] + innovation, variance)
    gain = before[OFFSET] / (before[OFFSET, OFFSET] + variance)
    assert s["mean"][0] == pytest.approx(mean + innovation * gain)
    assert s["covariance"][0] == pytest.approx(before - np.outer(gain, before[OFFSET]))
    assert (s["covariance"][0] == s["covariance"][0].T).all()


def test_rests_without_current_limit_the_error_of_the_soc_on_a_plateau() -> None:
    """An LFP cell is discharged from full for nine hours, with five minutes of rest in each half hour.

    Without rests, the offset would cause an error of up to 9 %.
    """
    case = Case(
        "LFP, rests", **LFP, load_c=0.1, hours=9.0, soc=1.0, load_before_h=0.0, file_capacity_ratio=1.0, seed=32
    )
    seconds = round(3600.0 * case.hours)
    current_a = load_a(case, seconds)
    current_a[np.arange(seconds) % 1800 < 300] = 0.0
    recording = capture(case, current_a)
    stds = []
    for zero_std_c in (None, 1.0):  # 1.0: rests give no information
        estimator = Estimator(recording.cell, identifier=IdentifierSettings(capacity_std=0.015), initial_soc=0.8)
        if zero_std_c is not None:
            estimator.settings_record["filter"]["zero_std_c"] = zero_std_c
        trace = estimator.run(recording.samples)
        result = score(trace["time_s"], trace["soc"], trace["soc_std"], recording.soc)
        stds.append(result.std)
        assert result.rmse < 1.0
        assert result.cover > 95.0
    std_with_rests, std_without = stds
    assert std_with_rests < 0.7 * std_without
