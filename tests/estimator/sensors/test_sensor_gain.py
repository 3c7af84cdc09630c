"""Gain errors of the sensors: defaults by source, and their effect on the interval."""

import numpy as np
import pytest
from pydantic import ValidationError

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.settings.observer import Sampling
from bms_estimator.settings.pack import Settings
from tests.estimator.simulated_cell import TRUTH, pulses


@pytest.mark.parametrize(
    ("tables", "voltage_gain_std"),
    [
        ({}, 0.001),
        ({"sensor": {"protocol": "jk"}}, 0.005),
        ({"sensor": {"protocol": "jk", "voltage_gain_std": 0.01}}, 0.01),
        ({"sensor": {"voltage_gain_std": 0.0}}, 0.0),
        ({"source": {"kind": "mqtt", "topic": "pack", "voltage": "u", "current": "i"}}, 0.005),
    ],
    ids=["board", "BMS", "configured BMS", "exact board", "MQTT"],
)
def test_the_gain_error_is_that_of_the_source_unless_configured(
    tables: dict[str, object], voltage_gain_std: float
) -> None:
    assert Settings.model_validate(tables).sampling.voltage_gain_std == voltage_gain_std


def test_a_gain_error_of_more_than_twenty_percent_is_rejected() -> None:
    with pytest.raises(ValidationError, match="current_gain_std"):
        Settings.model_validate({"sensor": {"current_gain_std": 0.5}})


@pytest.mark.parametrize(
    ("voltage_gain", "current_gain", "sampling"),
    [
        (1.01, 1.0, Sampling(voltage_gain_std=0.01)),
        (0.99, 1.0, Sampling(voltage_gain_std=0.01)),
        (1.0, 1.03, Sampling(current_gain_std=0.03)),
    ],
)
@pytest.mark.parametrize("initial_soc", [0.75, 1.0])
def test_the_truth_is_inside_the_interval_with_a_declared_gain_error(
    voltage_gain: float, current_gain: float, sampling: Sampling, initial_soc: float
) -> None:
    block, true_soc = pulses(soc=0.95)
    block["voltage_v"] *= voltage_gain
    block["current_a"] *= current_gain
    trace = Estimator(TRUTH, initial_soc=initial_soc, sampling=sampling).run(block)
    scored = block["time_s"] >= 900.0
    error, std = (trace["soc"] - true_soc)[scored], trace["soc_std"][scored]
    assert np.mean(np.abs(error) <= 2.0 * std) >= 0.93
    assert np.sqrt(np.mean(error**2)) <= 0.03


def test_an_undeclared_voltage_gain_is_outside_the_interval() -> None:
    """Without this the test above could not fail."""
    block, true_soc = pulses(soc=0.95)
    block["voltage_v"] *= 1.01
    trace = Estimator(TRUTH, initial_soc=0.75).run(block)
    inside = np.abs(trace["soc"] - true_soc) <= 2.0 * trace["soc_std"]
    assert np.mean(inside[block["time_s"] >= 900.0]) < 0.6


def test_a_board_widens_the_interval_by_little() -> None:
    block, _ = pulses(soc=0.95)
    stds = [
        Estimator(TRUTH, initial_soc=0.9, sampling=sampling).run(block)["soc_std"][900:].mean()
        for sampling in (Sampling(), Settings().sampling)
    ]
    assert stds[0] < stds[1] < 1.1 * stds[0]
