"""Recorded days of electrochemical cells, compared with PyBaMM's solution."""

import importlib.util

import numpy as np
import pytest

from tests.estimator.month.electrochemical import RECORDED, ElectrochemicalCase


@pytest.mark.thorough
@pytest.mark.skipif(importlib.util.find_spec("pybamm") is None, reason="PyBaMM has no solvers for this processor")
@pytest.mark.parametrize("case", RECORDED, ids=lambda case: case.name)
def test_the_recording_is_a_solution_of_pybamm(case: ElectrochemicalCase) -> None:
    recorded, solved = case.recorded(), case.solve()
    assert recorded.size == solved.size
    for name, error in (("time_s", 0.1), ("current_a", 1e-3), ("voltage_v", 1e-3), ("soc", 1e-4)):
        assert np.abs(recorded[name] - solved[name]).max() < error, name


@pytest.mark.parametrize("case", RECORDED, ids=lambda case: case.name)
def test_the_true_soc_is_the_counted_charge_over_the_capacity(case: ElectrochemicalCase) -> None:
    """The current changes linearly between two samples, and jumps between two phases."""
    truth = case.recorded()
    mean_a = 0.5 * (truth["current_a"][1:] + truth["current_a"][:-1])
    counted = np.cumsum(mean_a * np.diff(truth["time_s"])) / 3600.0 / truth["capacity_ah"][0]
    assert np.abs(truth["soc"][0] - counted - truth["soc"][1:]).max() < 0.005
