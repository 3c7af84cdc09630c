"""Samples with a held current: their voltage is used with the current that is interpolated at its own time."""

import numpy as np
import pytest

from bms_estimator.estimator import Estimator
from bms_estimator.model.sample import SampleBlock, SampleStatus
from bms_estimator.settings.sampling import Sampling
from tests.estimator.sensors.test_held_voltage import drive
from tests.estimator.simulated_cell import TRUTH, measured

PERIOD = 10
"""Seconds from one current to the next, and from one voltage to the next."""
SAMPLING = Sampling(period_s=PERIOD)


def skewed(block: SampleBlock) -> SampleBlock:
    """Return a current at the start of each period, and a voltage in its middle."""
    currents, voltages = block[::PERIOD].copy(), block[PERIOD // 2 :: PERIOD].copy()
    count = min(currents.size, voltages.size)
    currents, voltages = currents[:count], voltages[:count]
    voltages["current_a"], voltages["status"] = currents["current_a"], SampleStatus.CURRENT_HELD
    currents["voltage_v"][1:], currents["status"][1:] = voltages["voltage_v"][:-1], SampleStatus.VOLTAGE_HELD
    return np.stack([currents, voltages], axis=1).ravel()


def run(block: SampleBlock) -> np.ndarray:
    """Return the trace of an estimator that starts at SOC 0.7."""
    return Estimator(TRUTH, initial_soc=0.7, sampling=SAMPLING).run(block)


def test_a_voltage_between_two_currents_is_used_with_the_interpolated_current() -> None:
    """A current that changes linearly is interpolated exactly, so that the voltage is as good as a simultaneous one."""
    exact = measured(0.005 * np.arange(201), 0.7, np.random.default_rng(1))[0][:: PERIOD // 2]
    held = exact.copy()
    held["status"][1::2] = SampleStatus.CURRENT_HELD
    held["current_a"][1::2] = held["current_a"][:-1:2]
    skew, simultaneous = run(held), run(exact)
    assert skew["voltage_estimate_v"][-1] == pytest.approx(simultaneous["voltage_estimate_v"][-1], abs=1e-3)
    assert skew["soc_coulomb"][-1] == pytest.approx(simultaneous["soc_coulomb"][-1], abs=1e-9)
    assert skew["soc"][1::2].tolist() == skew["soc"][:-1:2].tolist()  # the SOC waits for the next current
    assert np.isnan(skew["soc_ocv"][1::2]).all()


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_fast_load_between_voltage_and_current_is_inside_the_interval(seed: int) -> None:
    block, true_soc = drive(seed=seed)
    trace = run(skewed(block))
    scored = trace["time_s"] >= 900.0
    error = (trace["soc"] - true_soc[np.rint(trace["time_s"]).astype(int)])[scored]
    assert np.mean(np.abs(error) <= 2.0 * trace["soc_std"][scored]) >= 0.93
    assert np.sqrt(np.mean(error**2)) <= 0.03


def test_a_voltage_corrects_less_if_the_current_changes_around_it() -> None:
    corrections = []
    for change_a in (0.0, 1.0, 4.0):
        estimator = Estimator(TRUTH, initial_soc=0.6, sampling=SAMPLING)
        block, _ = drive(hours=0.1)
        steady = block[: 4 * PERIOD : PERIOD].copy()
        steady["current_a"], steady["status"][1:] = 0.5, SampleStatus.VOLTAGE_HELD
        steady["current_a"][2:] += change_a
        estimator.run(steady[:2])
        before = float(estimator.record["filter"]["soc_std"][0])
        pending = steady[1:2].copy()
        pending["time_s"] += 0.5 * PERIOD
        pending["status"] = SampleStatus.CURRENT_HELD
        estimator.run(np.concatenate([pending, steady[2:3]]))
        corrections.append(before - float(estimator.record["filter"]["soc_std"][0]))
    assert corrections[0] > corrections[1] > corrections[2]


def test_step_and_run_agree_with_held_currents_however_the_samples_are_divided() -> None:
    block = skewed(drive(hours=0.2)[0])
    ran, stepped = Estimator(TRUTH, sampling=SAMPLING), Estimator(TRUTH, sampling=SAMPLING)
    for part in np.array_split(block, 7):
        ran.run(part)
    for time_s, current_a, voltage_v, temperature_c, *_, status in block.tolist():
        stepped.step(time_s, current_a, voltage_v, status, temperature_c)
    assert ran.record.tobytes() == stepped.record.tobytes()


def test_a_voltage_that_waits_across_a_gap_is_not_used() -> None:
    block = skewed(drive(hours=0.2)[0])
    with_voltage, without = block[:200].copy(), block[:200].copy()
    without = np.delete(without, 101)
    states = []
    for samples in (with_voltage, without):
        samples["time_s"][samples["time_s"] > block["time_s"][101]] += 60.0
        estimator = Estimator(TRUTH, sampling=SAMPLING)
        estimator.run(samples)
        record = estimator.record.copy()
        states.append(record["filter"].tobytes())
        assert estimator.state["gaps"][0] == 1
    assert states[0] == states[1]
