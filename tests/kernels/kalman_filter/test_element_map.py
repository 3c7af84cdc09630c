"""Fits to the map return the functions that it was filled from, and no information for unvisited SOC."""

import math

import numpy as np
import pytest
from numba.core.runtime import _nrt_python, rtsys

from bms_estimator.kernels.cell_model import chen_mora
from bms_estimator.kernels.kalman_filter.element_map import (
    ELEMENT_FIT,
    ELEMENT_MAP,
    ELEMENTS,
    EXPONENT_MAX,
    EXPONENT_MIN,
    add_observation,
    decay_weights,
    fit_element,
)
from bms_estimator.model.cell import load_cell

TRUTH = load_cell("chen_mora").a
FUNCTIONS = (chen_mora.r_ts, chen_mora.r_tl, chen_mora.c_ts, chen_mora.c_tl, chen_mora.r_s)


def filled(low: float, high: float, noise: float = 0.0) -> np.ndarray:
    rng = np.random.default_rng(2)
    table = np.zeros(1, dtype=ELEMENT_MAP)
    for soc in np.arange(low, high, 0.001):
        for e, function in enumerate(FUNCTIONS):
            add_observation(table[0], e, soc, math.log(function(soc, TRUTH)) + rng.normal(0, noise), 0.02**2, 1.0)
    return table


def fitted(table: np.ndarray, prior: np.ndarray) -> np.void:
    fit = np.zeros(1, dtype=ELEMENT_FIT)
    for e in range(ELEMENTS):
        fit_element(table[0], e, prior, fit[0])
    return fit[0]


def test_a_map_of_the_whole_range_gives_the_true_elements() -> None:
    fit = fitted(filled(0.02, 1.0, 0.01), TRUTH * 1.5)
    for e, function in enumerate(FUNCTIONS):
        assert fit["bins"][e] == 25
        for soc in (0.1, 0.3, 0.6, 0.95):
            assert function(soc, fit["a"]) == pytest.approx(function(soc, TRUTH), rel=0.04), (e, soc)


def test_true_offsets_lie_within_three_standard_errors() -> None:
    fit = fitted(filled(0.02, 1.0, 0.01), TRUTH * 1.5)
    for i in (3, 6, 9, 12, 15):
        assert abs(fit["a"][i] - TRUTH[i]) < 3 * fit["std"][i] < 0.2 * TRUTH[i]


def test_an_empty_map_gives_the_configured_values_without_std() -> None:
    fit = fitted(np.zeros(1, dtype=ELEMENT_MAP), TRUTH)
    assert list(fit["bins"]) == [0] * ELEMENTS
    assert fit["a"][1:] == pytest.approx(TRUTH[1:16])
    assert np.isnan(fit["std"][1:]).all()


def test_exponents_are_uncertain_with_data_at_high_soc_only() -> None:
    narrow, wide = fitted(filled(0.6, 1.0), TRUTH), fitted(filled(0.02, 1.0), TRUTH)
    assert narrow["std"][2] > 3 * wide["std"][2]


@pytest.mark.parametrize(("exponent", "end"), [(1e4, EXPONENT_MAX), (1e-3, EXPONENT_MIN)])
def test_an_exponent_beyond_the_searched_range_is_limited(exponent: float, end: float) -> None:
    prior = TRUTH.copy()
    prior[[2, 5, 8, 11, 14]] = exponent
    fit = fitted(filled(0.6, 0.61), prior)  # no data determine the exponent: the fit tends to the configured one
    found = fit["a"][[2, 5, 8, 11, 14]]
    assert (found >= EXPONENT_MIN).all()
    assert (found <= EXPONENT_MAX).all()
    assert np.abs(np.log(found / end)).min() < 0.05


def test_a_singular_fit_has_no_standard_errors() -> None:
    table = np.zeros(1, dtype=ELEMENT_MAP)
    add_observation(table[0], 0, 0.5, -3.0, 0.1**2, 10.0)
    table["moment"][0, 0, 12] = math.nan
    fit = fitted(table, TRUTH)
    assert np.isnan(fit["std"][1:4]).all()


def test_a_fit_allocates_no_memory() -> None:
    table, fit = filled(0.02, 1.0), np.zeros(1, dtype=ELEMENT_FIT)
    fit_element(table[0], 0, TRUTH, fit[0])
    _nrt_python.memsys_enable_stats()
    before = rtsys.get_allocation_stats().alloc
    for _ in range(100):
        fit_element(table[0], 0, TRUTH, fit[0])
    assert rtsys.get_allocation_stats().alloc - before <= 100  # one for each call, for passing the prior from Python


def test_an_uncertain_value_is_not_added() -> None:
    table = np.zeros(1, dtype=ELEMENT_MAP)
    add_observation(table[0], 0, 0.5, -3.0, 0.5**2, 10.0)
    add_observation(table[0], 0, 0.5, -3.0, math.nan, 10.0)
    assert table["weight"].sum() == 0.0


def test_new_evidence_outweighs_aged_evidence() -> None:
    table = np.zeros(1, dtype=ELEMENT_MAP)
    add_observation(table[0], 4, 0.5, math.log(0.1), 0.01**2, 100.0)
    decay_weights(table[0], 4, 0.01)
    add_observation(table[0], 4, 0.5, math.log(0.2), 0.01**2, 100.0)
    value = math.exp(table["moment"][0, 4, 12] / table["weight"][0, 4, 12])
    assert value == pytest.approx(0.2, rel=0.02)
