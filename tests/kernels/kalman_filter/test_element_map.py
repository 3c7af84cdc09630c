"""Fits of a1..a15 to the map of circuit elements over SOC: accuracy, standard errors, limits, and forgetting.

The map has the elements R_ts, R_tl, C_ts, C_tl and R_s in bins of the SOC. Each element has an amplitude, an exponent
and an offset: a1..a3 for R_ts, and so on.
"""

import math

import numpy as np
import pytest
from numba.core.runtime import _nrt_python, rtsys

from bms_estimator.kernels.cell_model import chen_mora
from bms_estimator.kernels.kalman_filter.element_map import (
    BINS,
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
"""True parameters a1..a15 at index 1 to 15."""
WRONG_PRIOR = TRUTH * 1.5
EXPONENTS = [2, 5, 8, 11, 14]
"""Indices of the exponents in ``a``."""
OFFSETS = (3, 6, 9, 12, 15)
"""Indices of the offsets in ``a``."""

ELEMENT_FUNCTIONS = (chen_mora.r_ts, chen_mora.r_tl, chen_mora.c_ts, chen_mora.c_tl, chen_mora.r_s)


def fill_map(low: float, high: float, noise: float = 0.0) -> np.ndarray:
    """Return a map of the true elements from SOC ``low`` to ``high``; ``noise`` is the std of their logarithms."""
    rng = np.random.default_rng(2)
    table = np.zeros(1, dtype=ELEMENT_MAP)
    for soc in np.arange(low, high, 0.001):
        for e, function in enumerate(ELEMENT_FUNCTIONS):
            ln_value = math.log(function(soc, TRUTH)) + rng.normal(0, noise)
            add_observation(table[0], e, soc, ln_value, 0.02**2, 1.0)
    return table


def fit_map(table: np.ndarray, prior: np.ndarray) -> np.void:
    """Return the fit of all elements to the map, with the parameters ``prior`` as prior."""
    fit = np.zeros(1, dtype=ELEMENT_FIT)
    for e in range(ELEMENTS):
        fit_element(table[0], e, prior, fit[0])
    return fit[0]


def test_a_map_of_the_whole_range_gives_the_true_elements() -> None:
    fit = fit_map(fill_map(0.02, 1.0, noise=0.01), WRONG_PRIOR)
    for e, function in enumerate(ELEMENT_FUNCTIONS):
        assert fit["bins"][e] == BINS
        for soc in (0.1, 0.3, 0.6, 0.95):
            assert function(soc, fit["a"]) == pytest.approx(function(soc, TRUTH), rel=0.04), (e, soc)


def test_true_offsets_lie_within_three_standard_errors() -> None:
    fit = fit_map(fill_map(0.02, 1.0, noise=0.01), WRONG_PRIOR)
    for i in OFFSETS:
        assert abs(fit["a"][i] - TRUTH[i]) < 3 * fit["std"][i] < 0.2 * TRUTH[i]


def test_the_std_of_delta_is_that_of_linear_error_propagation_without_the_common_factor() -> None:
    table, fit, c_ts = fill_map(0.02, 1.0, noise=0.01), np.zeros(1, dtype=ELEMENT_FIT), 2
    fit_element(table[0], c_ts, TRUTH, fit[0])
    amplitude, exponent, offset = fit[0]["a"][7:10]
    decay = np.exp(-exponent * fit[0]["soc"])
    jacobian = np.column_stack([-decay, fit[0]["soc"] * amplitude * decay, np.ones(BINS)])
    prior = np.diag((3.0 * np.array([amplitude, exponent, offset])) ** -2)
    covariance = np.linalg.inv(jacobian.T @ (fit[0]["weight"][:, None] * jacobian) + prior)

    def delta_of(a: np.ndarray) -> float:
        return chen_mora.delta(a[1], a[2], a[0])

    a = np.array([amplitude, exponent, offset])
    steps = np.diag(1e-6 * a)
    gradient = np.array([(delta_of(a + step) - delta_of(a - step)) / (2.0 * step.sum()) for step in steps])
    assert fit[0]["delta_std"][c_ts] == pytest.approx(math.sqrt(gradient @ covariance @ gradient), rel=1e-6)


def test_an_empty_map_gives_the_prior_values_without_std() -> None:
    fit = fit_map(np.zeros(1, dtype=ELEMENT_MAP), TRUTH)
    assert list(fit["bins"]) == [0] * ELEMENTS
    assert fit["a"][1:] == pytest.approx(TRUTH[1:16])
    assert np.isnan(fit["delta_std"]).all()
    assert np.isnan(fit["std"][1:]).all()


def test_exponents_are_uncertain_with_data_at_high_soc_only() -> None:
    narrow, wide = fit_map(fill_map(0.6, 1.0), TRUTH), fit_map(fill_map(0.02, 1.0), TRUTH)
    exponent_of_r_ts = EXPONENTS[0]
    assert narrow["std"][exponent_of_r_ts] > 3 * wide["std"][exponent_of_r_ts]


@pytest.mark.parametrize(("exponent", "limit"), [(1e4, EXPONENT_MAX), (1e-3, EXPONENT_MIN)])
def test_an_exponent_beyond_the_searched_range_is_limited(exponent: float, limit: float) -> None:
    prior = TRUTH.copy()
    prior[EXPONENTS] = exponent
    # Data at a single SOC do not determine the exponent, so that the fit tends to the prior.
    fit = fit_map(fill_map(0.6, 0.61), prior)
    exponents = fit["a"][EXPONENTS]
    assert (exponents >= EXPONENT_MIN).all()
    assert (exponents <= EXPONENT_MAX).all()
    assert np.abs(np.log(exponents / limit)).min() < 0.05


def test_a_fit_to_a_non_finite_value_has_no_standard_errors() -> None:
    table = np.zeros(1, dtype=ELEMENT_MAP)
    add_observation(table[0], 0, 0.5, -3.0, 0.1**2, 10.0)
    table["moment"][0, 0, int(0.5 * BINS)] = math.nan
    fit = fit_map(table, TRUTH)
    assert np.isnan(fit["std"][1:4]).all()


def test_a_fit_allocates_no_memory() -> None:
    table, fit = fill_map(0.02, 1.0), np.zeros(1, dtype=ELEMENT_FIT)
    fit_element(table[0], 0, TRUTH, fit[0])
    _nrt_python.memsys_enable_stats()
    before = rtsys.get_allocation_stats().alloc
    calls = 100
    for _ in range(calls):
        fit_element(table[0], 0, TRUTH, fit[0])
    # Passing the prior from Python allocates once for each call.
    assert rtsys.get_allocation_stats().alloc - before <= calls


def test_a_value_with_a_large_or_unknown_variance_is_not_added() -> None:
    table = np.zeros(1, dtype=ELEMENT_MAP)
    add_observation(table[0], 0, 0.5, -3.0, 0.5**2, 10.0)
    add_observation(table[0], 0, 0.5, -3.0, math.nan, 10.0)
    assert table["weight"].sum() == 0.0


def test_new_values_outweigh_aged_values() -> None:
    table, r_s, soc_bin = np.zeros(1, dtype=ELEMENT_MAP), ELEMENT_FUNCTIONS.index(chen_mora.r_s), int(0.5 * BINS)
    add_observation(table[0], r_s, 0.5, math.log(0.1), 0.01**2, 100.0)
    decay_weights(table[0], r_s, 0.01)
    add_observation(table[0], r_s, 0.5, math.log(0.2), 0.01**2, 100.0)
    value = math.exp(table["moment"][0, r_s, soc_bin] / table["weight"][0, r_s, soc_bin])
    assert value == pytest.approx(0.2, rel=0.02)
