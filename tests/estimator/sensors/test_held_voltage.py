"""Samples with a held voltage: their current counts, and their voltage has no effect."""

import numpy as np
import pytest

from bms_estimator.estimator import Estimator
from bms_estimator.model.sample import SampleBlock, SampleStatus
from bms_estimator.settings.observer import IdentifierSettings, ObserverSettings
from tests.estimator.simulated_cell import TRUTH, measured

VOLTAGE_PERIOD = 10
"""Number of samples from one measured voltage to the next."""


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


def test_step_and_run_agree_with_held_voltages() -> None:
    block = with_held_voltages(drive(hours=0.2)[0])
    ran, stepped = Estimator(TRUTH), Estimator(TRUTH)
    ran.run(block)
    for time_s, current_a, voltage_v, temperature_c, *_, status in block.tolist():
        stepped.step(time_s, current_a, voltage_v, status, temperature_c)
    assert ran.record.tobytes() == stepped.record.tobytes()
