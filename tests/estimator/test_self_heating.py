"""How warm a cell makes itself, against one that was measured."""

from pathlib import Path

import numpy as np

from bms_estimator.estimator import Estimator
from bms_estimator.kernels.ladder import REFERENCE_C
from bms_estimator.model.cell import load_cell
from bms_estimator.sources.replay import load_capture

HALF_C = Path(__file__).parents[1] / "data" / "lgm50" / "rate_0p5c_25c.csv.gz"


def rise_k(samples):
    """How much warmer than a room the estimator takes an LG M50 for, of which it knows chemistry and capacity [K]."""
    estimator = Estimator(load_cell("nmc", 5.0), initial_soc=1.0)
    filtered = estimator.record["filter"]
    rise_k = np.zeros(samples.size)
    for n, (time_s, current_a, voltage_v, temperature_c, status) in enumerate(samples.tolist()):
        estimator.step(time_s, current_a, voltage_v, status, temperature_c)
        rise_k[n] = filtered["temperature_c"][0] - REFERENCE_C
    return rise_k


def test_without_a_sensor_a_cell_is_as_warm_as_one_that_was_measured() -> None:
    samples = load_capture(HALF_C).rows
    measured_k = samples["temperature_c"] - samples["temperature_c"][0]
    samples["temperature_c"] = np.nan
    error_k = rise_k(samples) - measured_k
    assert np.sqrt(np.mean(measured_k**2)) > 1.5
    assert np.sqrt(np.mean(error_k**2)) < 0.6


def test_a_sensor_is_believed() -> None:
    samples = load_capture(HALF_C).rows
    samples["temperature_c"] = 10.0
    assert np.all(rise_k(samples) == 10.0 - REFERENCE_C)
