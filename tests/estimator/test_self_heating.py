"""Modelled self-heating of a cell, compared with measurements."""

import math
from pathlib import Path

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.kernels.cell_model.rc_ladder import REFERENCE_C
from bms_estimator.kernels.kalman_filter.window import COOLING_S, MAX_MODELLED_C
from bms_estimator.model.arrays import SAMPLE
from bms_estimator.model.cell import load_cell
from bms_estimator.sources.captures.replay import load_capture

HALF_C_CAPTURE = Path(__file__).parents[1] / "data" / "lgm50" / "rate_0p5c_25c.csv.gz"
"""Discharge of an LG M50 (5 Ah) at C/2, with its measured temperature."""


def temperature_rise_k(samples, cell=None):
    """Run an estimator over the samples; return the rise of the temperature that it uses above 25 C [K].

    Without ``cell``, the estimator has the generic cell file of an LG M50.
    """
    estimator = Estimator(cell or load_cell("nmc", 5.0), initial_soc=1.0)
    rise_k = np.zeros(samples.size)
    for n, (time_s, current_a, voltage_v, temperature_c, *_, status) in enumerate(samples.tolist()):
        estimator.step(time_s, current_a, voltage_v, status, temperature_c)
        rise_k[n] = used_temperature_c(estimator) - REFERENCE_C
    return rise_k


def used_temperature_c(estimator):
    """Return the temperature that the filter uses [C]."""
    return estimator.record["filter"]["temperature_c"][0]


def run_at_1_c(estimator, seconds=600):
    """Process a load of 1 C for a cell of 5 Ah; return the temperature that the filter uses [C]."""
    for second in range(seconds):
        estimator.step(float(second), 5.0, 3.9)
    return used_temperature_c(estimator)


def test_the_modelled_temperature_matches_a_measured_one() -> None:
    samples = load_capture(HALF_C_CAPTURE).rows
    measured_k = samples["temperature_c"] - samples["temperature_c"][0]
    samples["temperature_c"] = np.nan
    error_k = temperature_rise_k(samples) - measured_k
    assert np.sqrt(np.mean(measured_k**2)) > 1.5  # the cell warms enough for the comparison
    assert np.sqrt(np.mean(error_k**2)) < 0.6


def test_a_pack_has_the_temperature_of_its_cells() -> None:
    samples = np.zeros(900, dtype=SAMPLE)
    samples["time_s"], samples["temperature_c"] = np.arange(900.0), np.nan
    samples["current_a"], samples["voltage_v"] = 5.0, 3.9
    cell = load_cell("nmc", 5.0)
    cell_rise_k = temperature_rise_k(samples, cell)
    samples["current_a"], samples["voltage_v"] = 2 * 5.0, 4 * 3.9  # two cells in parallel, four in series
    assert cell_rise_k[-1] > 2.0
    assert temperature_rise_k(samples, cell.pack(4, 2)) == pytest.approx(cell_rise_k, rel=0.02)


def test_a_measured_temperature_replaces_the_modelled_one() -> None:
    samples = load_capture(HALF_C_CAPTURE).rows
    samples["temperature_c"] = 10.0
    assert np.all(temperature_rise_k(samples) == 10.0 - REFERENCE_C)


@pytest.mark.parametrize("gap_s", [COOLING_S, 8 * 3600.0, math.inf], ids=["minutes", "a night", "unknown duration"])
def test_a_cell_cools_in_a_gap(gap_s: float) -> None:
    estimator = Estimator(load_cell("nmc", 5.0), initial_soc=0.9)
    warm_k = run_at_1_c(estimator) - REFERENCE_C
    assert warm_k > 2.0
    estimator.resume(gap_s)
    estimator.step(0.0, 0.0, 3.9)
    estimator.step(1.0, 0.0, 3.9)
    assert 0.0 <= used_temperature_c(estimator) - REFERENCE_C < warm_k * (0.1 if gap_s > COOLING_S else 0.9)


def test_the_modelled_temperature_is_limited() -> None:
    estimator = Estimator(load_cell("nmc", 5.0), initial_soc=0.9)
    for second in range(300):
        estimator.step(float(second), 99.0, 3.9)  # 20 C
    assert REFERENCE_C < used_temperature_c(estimator) <= MAX_MODELLED_C
    assert np.isfinite(estimator.record["filter"]["soc"][0])
