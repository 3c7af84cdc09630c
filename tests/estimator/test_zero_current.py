"""What a rest that shows no current tells of the current sensor, and what it does not."""

import numpy as np
import pytest

from bms_estimator.estimator import Estimator
from bms_estimator.kernels import ekf
from bms_estimator.kernels.ekf_state import EKF_STATE, OFFSET, STATES
from bms_estimator.model.cell import load_cell
from bms_estimator.model.resolution import Sampling
from bms_estimator.model.sample import SAMPLE
from bms_estimator.model.settings import IdentifierSettings
from tests.estimator.anywhere.cases import LFP, Case, capture, load_a
from tests.estimator.anywhere.score import score

CAPACITY_AH = 3.0
FIRST_STD_A, ZERO_STD_A = 0.007 * CAPACITY_AH, 0.001 * CAPACITY_AH
FINE_A = 0.002


def offset_after(shown_a, sampling=None, smallest_a=FINE_A):
    """Offset and its std [A] after ten minutes of load, which shows ``smallest_a`` once, and two of ``shown_a``."""
    rng = np.random.default_rng(1)
    samples = np.zeros(720, dtype=SAMPLE)
    samples["time_s"] = np.arange(720.0)
    samples["current_a"][:600] = np.repeat(rng.uniform(1.0, 3.0, 30), 20)
    samples["current_a"][300:320] = smallest_a
    samples["current_a"][600:] = shown_a
    samples["voltage_v"], samples["temperature_c"] = 3.7 - 0.03 * samples["current_a"], 25.0
    estimator = Estimator(
        load_cell("nmc", CAPACITY_AH), initial_soc=0.6, **({"sampling": sampling} if sampling else {})
    )
    estimator.run(samples)
    f = estimator.record[0]["filter"]
    return f["mean"][f["best"], OFFSET], np.sqrt(f["covariance"][f["best"], OFFSET, OFFSET])


def test_a_sensor_that_shows_no_current_at_rest_has_no_offset() -> None:
    offset_a, std_a = offset_after(0.0)
    assert abs(offset_a) < 1e-3
    assert ZERO_STD_A <= std_a < 1.1 * ZERO_STD_A


def test_noise_of_the_sensor_hides_no_zero() -> None:
    noise_a = np.random.default_rng(2).normal(0.0, 5e-3, 120)
    offset_a, std_a = offset_after(noise_a, smallest_a=1.0)
    assert abs(offset_a) < 2e-3
    assert std_a < 1.1 * ZERO_STD_A


@pytest.mark.parametrize(
    "unknown",
    [
        {"shown_a": 0.05},
        {"shown_a": -0.05},
        {"shown_a": 0.02},
        {"shown_a": 0.0, "smallest_a": 0.3},
        {"shown_a": 0.0, "sampling": Sampling(1.0, 0.0, 0.5)},
        {"shown_a": 0.0, "sampling": Sampling(1.0, 0.1)},
    ],
    ids=["50 mA", "-50 mA", "20 mA", "nothing small was ever shown", "dead band", "coarse steps"],
)
def test_what_may_be_a_load_or_hidden_tells_nothing(unknown) -> None:
    assert offset_after(**unknown)[1] > 0.7 * FIRST_STD_A


def test_learning_a_state_is_a_textbook_update() -> None:
    rng = np.random.default_rng(3)
    s = np.zeros(1, EKF_STATE)[0]
    mixed = rng.standard_normal((STATES, STATES))
    before, mean = mixed @ mixed.T, rng.standard_normal(STATES)
    mean[0] = 0.5
    s["covariance"][0], s["mean"][0] = before, mean
    ekf.learn(s, 0, OFFSET, mean[OFFSET] + 0.01, 0.3)
    gain = before[OFFSET] / (before[OFFSET, OFFSET] + 0.3)
    assert s["mean"][0] == pytest.approx(mean + 0.01 * gain)
    assert s["covariance"][0] == pytest.approx(before - np.outer(gain, before[OFFSET]))
    assert (s["covariance"][0] == s["covariance"][0].T).all()


def test_a_plateau_is_counted_through_when_rests_show_no_current() -> None:
    """Nine hours of LFP from full, five minutes of rest in each half hour: without them the offset alone may be 9 %."""
    case = Case("LFP, rests", **LFP, load_c=0.1, hours=9.0, soc=1.0, unseen_h=0.0, capacity=1.0, seed=32)
    seconds = round(3600.0 * case.hours)
    current_a = load_a(case, seconds)
    current_a[np.arange(seconds) % 1800 < 300] = 0.0
    seen = capture(case, current_a)
    stds = []
    for zero_std_c in (None, 1.0):
        estimator = Estimator(seen.cell, identifier=IdentifierSettings(capacity_std=0.015), initial_soc=0.8)
        if zero_std_c is not None:
            estimator.settings_record["filter"]["zero_std_c"] = zero_std_c
        trace = estimator.run(seen.samples)
        found = score(trace["time_s"], trace["soc"], trace["soc_std"], seen.soc)
        stds.append(found.std)
        assert found.rmse < 1.0
        assert found.cover > 95.0
    assert stds[0] < 0.7 * stds[1]
