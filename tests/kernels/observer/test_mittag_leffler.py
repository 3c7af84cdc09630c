"""Mittag-Leffler function E_a(-r^a): comparison with its series in many digits, and the property of a Nussbaum gain."""

import math

import mpmath
import numpy as np
import pytest

from bms_estimator.kernels.observer.mittag_leffler import SERIES_LIMIT, decay_table, mittag_leffler, series_coefficients

MAX_R = 60.0
"""Maximum of the tested arguments r."""


def sum_series(alpha: float, r: float) -> float:
    """Return the sum of the series (3.11) of the thesis at z = -r^alpha.

    The terms grow to about e^r before they fall. Therefore the number of digits and of terms grows with r.
    """
    with mpmath.workdps(60 + int(r)):
        a, z = mpmath.mpf(alpha), -(mpmath.mpf(r) ** mpmath.mpf(alpha))
        return float(sum(z**k / mpmath.gamma(a * k + 1) for k in range(40 + int(3 * r))))


@pytest.mark.parametrize("alpha", [2.05, 2.5, 2.9, 2.999, 3.0])
def test_the_error_is_below_1e_10_of_the_amplitude_for_r_in_0_to_60(alpha: float) -> None:
    series, (value, slope) = series_coefficients(alpha), decay_table(alpha)
    for r in np.concatenate([[0.0, SERIES_LIMIT - 1e-3, SERIES_LIMIT + 1e-3], np.linspace(0.05, MAX_R, 40)]):
        # The function oscillates with an exponentially growing amplitude.
        amplitude = max(1.0, 2.0 / alpha * math.exp(r * math.cos(math.pi / alpha)))
        assert abs(mittag_leffler(r, alpha, series, value, slope) - sum_series(alpha, r)) < 1e-10 * amplitude


def test_the_value_at_zero_is_one() -> None:
    assert mittag_leffler(0.0, 2.5, series_coefficients(2.5), *decay_table(2.5)) == 1.0


@pytest.mark.parametrize("alpha", [2.0, 3.01, 0.5, math.nan])
def test_an_alpha_without_the_nussbaum_property_is_rejected(alpha: float) -> None:
    with pytest.raises(ValueError, match=r"must be in \(2, 3\]"):
        decay_table(alpha)


def test_the_swings_of_the_mean_over_0_to_k_grow_in_both_directions() -> None:
    """By definition 2.2.2.1 of the thesis, the mean of a Nussbaum gain N over 0..k is unbounded above and below."""
    series, (value, slope) = series_coefficients(2.5), decay_table(2.5)
    k = np.linspace(0.0, 40.0, 40_001)
    n = np.array([mittag_leffler(x, 2.5, series, value, slope) for x in k])
    mean = np.cumsum(n)[1:] * (k[1] - k[0]) / k[1:]
    early, late = mean[: len(mean) // 2], mean[len(mean) // 2 :]
    assert late.max() > 10 * early.max() > 0
    assert late.min() < 10 * early.min() < 0
