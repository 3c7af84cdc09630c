"""Samples with a held value: a held voltage has no effect, and a voltage with a held current is used at its own time."""

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.model.arrays import SampleBlock, SampleStatus
from bms_estimator.settings.observer import EXACT, IdentifierSettings, ObserverSettings, Sampling
from tests.estimator.simulated_cell import TRUTH, measured, run_divided

VOLTAGE_PERIOD = 10
"""Number of samples from one measured voltage to the next."""
PERIOD = 10
"""Time from one current to the next, and from one voltage to the next, if the current is held [s]."""
SAMPLING = Sampling(period_s=PERIOD)


def with_held_voltages(block: SampleBlock) -> SampleBlock:
    """Return the samples with only each tenth voltage; the other samples have the voltage of an earlier one."""
    held = block.copy()
    index = np.arange(block.size)
    held["voltage_v"] = block["voltage_v"][index - index % VOLTAGE_PERIOD]
    held["status"] = np.where(index % VOLTAGE_PERIOD, SampleStatus.VOLTAGE_HELD, 0)
    return held


def drive(hours: float = 1.5, level_s: int = 7, seed: int = 1) -> tuple[SampleBlock, np.ndarray]:
    """Return samples at 1 Hz of a load that changes every ``level_s`` from SOC 0.9 on, and the true SOC."""
    rng = np.random.default_rng(seed)
    levels_a = rng.choice([0.0, 0.5, 1.0, 2.0, 4.0, -1.5], int(3600 * hours) // level_s)
    return measured(np.repeat(levels_a, level_s), 0.9, rng)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"observer": ObserverSettings(law="learning"), "identifier": None},
        {"observer": ObserverSettings(law="learning"), "identifier": IdentifierSettings()},
    ],
    ids=["filter", "learning law", "filter and learning law"],
)
def test_the_value_of_a_held_voltage_has_no_effect(options: dict[str, object]) -> None:
    held, _ = drive(hours=0.5)
    held = with_held_voltages(held)
    other = held.copy()
    other["voltage_v"][held["status"] != 0] = 3.0
    states = []
    for block in (held, other):
        estimator = Estimator(TRUTH, initial_soc=0.8, **options)  # type: ignore[arg-type]
        estimator.run(block)
        record = estimator.record.copy()
        if not options:  # the observer of the thesis holds the voltage as its input
            record["observer"]["v_ts"] = record["observer"]["v_tl"] = 0.0
            parts = "filter", "elements", "checks", "counters", "map"
        else:
            parts = "filter", "learning", "checks"
        states.append([record[part].tobytes() for part in parts] + [record["observer"]["soc"].tobytes()])
    assert states[0] == states[1]


def test_the_soc_follows_the_current_between_two_measured_voltages() -> None:
    block, true_soc = drive(hours=1.0)
    estimator = Estimator(TRUTH, initial_soc=0.9)
    trace = estimator.run(with_held_voltages(block))
    last = np.flatnonzero(np.arange(block.size) % VOLTAGE_PERIOD == VOLTAGE_PERIOD - 1)[30:]  # without the first 5 min
    first = last - (VOLTAGE_PERIOD - 2)  # sample after the measured voltage, whose correction is complete there
    counted = true_soc[last] - true_soc[first]
    assert trace["soc"][last] - trace["soc"][first] == pytest.approx(counted, abs=3e-4)
    assert np.ptp(counted) > 0.003
    assert np.isnan(trace["soc_ocv"][last]).all()
    assert np.isfinite(trace["soc_ocv"][::VOLTAGE_PERIOD]).all()


@pytest.mark.parametrize("initial_soc", [0.7, 1.0])
def test_a_voltage_each_ten_seconds_gives_nearly_the_soc_of_simultaneous_samples(initial_soc: float) -> None:
    block, true_soc = drive()
    scored = block["time_s"] >= 900.0
    rmse = []
    for samples in (block, with_held_voltages(block)):
        trace = Estimator(TRUTH, initial_soc=initial_soc).run(samples)
        error, std = (trace["soc"] - true_soc)[scored], trace["soc_std"][scored]
        assert np.mean(np.abs(error) <= 2.0 * std) >= 0.95
        rmse.append(float(np.sqrt(np.mean(error**2))))
    assert rmse[1] <= max(1.2 * rmse[0], 0.01)


def test_a_held_voltage_is_not_a_frozen_one() -> None:
    block, _ = drive()
    estimator = Estimator(TRUTH, initial_soc=0.9)
    suspects = 0
    for part in np.array_split(with_held_voltages(block), 50):
        estimator.run(part)
        suspects |= int(estimator.record["checks"]["suspects"][0])
    assert suspects == 0
    assert estimator.record["counters"]["gated"][0] == 0


def test_after_a_gap_the_first_measured_voltage_finds_the_soc() -> None:
    block, true_soc = drive(hours=2.0)
    estimator = Estimator(TRUTH, initial_soc=0.9)
    estimator.run(block[:2400])
    later = with_held_voltages(block[4805:])  # the discharge in between is not measured
    later["status"][:VOLTAGE_PERIOD] = SampleStatus.VOLTAGE_HELD
    before = int(estimator.record["filter"]["count"][0])
    estimator.run(later[:VOLTAGE_PERIOD])
    assert estimator.record["filter"]["count"][0] == before == 1
    estimator.run(later[VOLTAGE_PERIOD : VOLTAGE_PERIOD + 1])
    assert estimator.record["filter"]["count"][0] > 1
    trace = estimator.run(later[VOLTAGE_PERIOD + 1 :])
    assert abs(trace["soc"][-1] - true_soc[-1]) <= 2.0 * trace["soc_std"][-1]


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


@pytest.mark.parametrize("voltage", [True, False], ids=["voltage", "current"])
def test_step_and_run_agree_with_held_values_however_the_samples_are_divided(voltage: bool) -> None:
    sampling = EXACT if voltage else SAMPLING
    block = (with_held_voltages if voltage else skewed)(drive(hours=0.2)[0])
    run_divided(lambda: Estimator(TRUTH, sampling=sampling), block)


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
