"""Limits, means and deltas of the thesis's parameters a1..a15, compared with results by hand.

The limit of a parameter is the mean of its upper and lower bound with the weights x and y (Lemma 4.1.3). Its estimate
is the mean (3.19) over the time in which it moves from the initial value to the limit. delta1 (2.11) and delta2 (2.12)
are the SOCs at which C_ts and C_tl are zero. Errata are those of ``bms_estimator.reports.thesis.errata``.
"""

import numpy as np
import pytest

from bms_estimator.kernels.cell_model.chen_mora import delta
from bms_estimator.model.cell import load_cell
from bms_estimator.reports.thesis import printed_values

LIMITS_4 = {1: 0.2995, 3: 0.04485, 6: 0.04990, 13: 0.1495, 15: 0.06970}
"""Limits of Table 4 by hand, by index of the parameter: (100 upper + lower) / 101."""
LIMITS_5_AND_10 = {
    1: 0.5500,
    2: 30.00,
    3: 0.05500,
    4: 5.500,
    5: 150.0,
    6: 0.05500,
    7: 760.9,
    8: 10.67,
    9: 684.6,
    10: 6000.0,
    11: 27.50,
    12: 3667.0,
}
"""Limits of Tables 5 and 10 by hand, by index of the parameter: (x upper + y lower) / (x + y).

The weights of a8 are those of erratum 4. a5 of Table 10 is that of erratum 5.
"""
INFERRED_LIMITS = {("5", 7): 759.3, ("10", 7): 759.3, ("10", 4): 6.250}
"""Limits by hand, by table and index, with the weights of errata 24 and 32."""
ESTIMATES_5 = "0.5555 29.9996 0.0557 5.6095 149.9983 0.0630 759.2573 10.6712 684.61 5999.6 27.5014 3666.6"
"""Printed estimates of a1..a12 in Table 5, with all digits."""
ESTIMATES_10 = (0.5505, 30.0475, 0.0551, 6.2585, 150.0, 0.0551, 760.2266, 10.7686, 685.7457, 6036.4, 27.5422, 3696.0)
"""Printed estimates of a1..a12 in Table 10, but a5 as in erratum 5 instead of 30."""
WORST_PERCENT = 0.28
"""Largest difference between a computed mean and Table 10, that of a8 [%]."""


def round_to_four_digits(value):
    """Round a number to four significant digits."""
    return float(f"{value:.4g}")


@pytest.mark.parametrize(("index", "expected"), LIMITS_4.items())
def test_limits_of_table_4_to_four_digits(index, expected):
    upper, lower, *_ = printed_values.TABLE_4[index]
    x, y = printed_values.TABLE_4_WEIGHTS
    assert round_to_four_digits((x * upper + y * lower) / (x + y)) == expected


@pytest.mark.parametrize("cell", ["chen_mora", "thunder_power_6s"])
@pytest.mark.parametrize(("index", "expected"), LIMITS_5_AND_10.items())
def test_limits_of_tables_5_and_10_to_four_digits(cell, index, expected):
    for table in ("5", "10"):
        assert round_to_four_digits(printed_values.bounds(table, index).limit) == INFERRED_LIMITS.get(
            (table, index), expected
        )
    assert round_to_four_digits(load_cell(cell).bounds(index).limit) == expected


def test_the_printed_weights_of_a8_give_another_limit():
    upper, lower, x, y = printed_values.BOUNDS[8]
    assert (upper, lower, x, y) == (30, 1, 50, 10)
    assert round_to_four_digits((x * upper + y * lower) / (x + y)) == 25.17  # erratum 4


@pytest.mark.parametrize(("index", "digits"), list(enumerate(ESTIMATES_5.split(), 1)))
def test_means_from_the_first_sample_on_are_the_estimates_of_table_5(index, digits):
    """Only bounds, initial values and the weights of erratum 32 are used, and no data (erratum 3)."""
    assert printed_values.TABLE_5[index][1] == float(digits)
    decimals = len(digits.partition(".")[2])
    assert f"{printed_values.mean_from_start('5', index):.{decimals}f}" == digits
    assert printed_values.DECIMALS_5[index] == decimals


@pytest.mark.parametrize("index", [7, 8, 10, 11, 12])
def test_printed_weights_do_not_give_the_digits_of_table_5(index):
    upper, lower, x, y = printed_values.BOUNDS[index]
    # For a7 and a8, weights with the correct limit are used (errata 24 and 4).
    x, y = {7: (70.0, 65.0), 8: (10.0, 20.0)}.get(index, (x, y))
    limit = (x * upper + y * lower) / (x + y)
    mean = limit + (printed_values.initial("5", index) - limit) / ((x + y) * printed_values.START_MEAN_S["5"])
    decimals = printed_values.DECIMALS_5[index]
    assert round(mean, decimals) != printed_values.TABLE_5[index][1]
    low, high = printed_values.implied_rates(index)
    assert not low <= x + y <= high


def test_no_other_integer_weights_up_to_800_give_the_printed_digits_of_a7():
    """By erratum 32, 196 and 182 are the only integers that give the estimate.

    The duration of the mean follows from a4.
    """
    durations_s, initial_value, estimate = (328.12, 328.4), 510.0, 759.2573
    x, y = (grid.ravel() for grid in np.mgrid[1:801, 1:801])
    limit = (1000.0 * x + 500.0 * y) / (x + y)
    means = [limit + (initial_value - limit) / ((x + y) * duration_s) for duration_s in durations_s]
    fits = (np.minimum(*means) <= estimate + 5e-5) & (np.maximum(*means) >= estimate - 5e-5)  # four decimals
    assert list(zip(x[fits], y[fits], strict=True)) == [(196, 182)]


@pytest.mark.parametrize(("index", "estimate"), list(enumerate(ESTIMATES_10, 1)))
def test_means_from_the_first_sample_on_are_near_table_10(index, estimate):
    assert printed_values.mean_from_start("10", index) == pytest.approx(estimate, rel=1e-2 * WORST_PERCENT)


def test_worst_mean_of_table_10():
    assert printed_values.worst_mean_percent() == pytest.approx(WORST_PERCENT, abs=0.005)


def test_free_parameters_are_counted_from_the_inferred_weights():
    """Free parameters are the time, the rate of each inferred pair, and its ratio unless the ratio is printed."""
    for table, pairs in printed_values.INFERRED_WEIGHTS.items():
        ratios = [x / y != printed_values.BOUNDS[i][2] / printed_values.BOUNDS[i][3] for i, (x, y) in pairs.items()]
        assert printed_values.FREE_PARAMETERS[table] == 1 + len(pairs) + sum(ratios)


def test_inferred_weights_give_the_printed_estimates_and_printed_weights_do_not():
    for table, index, mean, estimate in (
        ("5", 7, 759.2573, 759.2573),
        ("10", 7, 760.1875, 760.2266),
        ("10", 4, 6.2583, 6.2585),
    ):
        assert printed_values.mean_from_start(table, index) == pytest.approx(mean, rel=1e-5)
        assert mean == pytest.approx(estimate, rel=1e-4)
        upper, lower, x, y = printed_values.BOUNDS[index]
        limit = (x * upper + y * lower) / (x + y)
        mean_by_printed_weights = limit + (printed_values.initial(table, index) - limit) / (
            (x + y) * printed_values.START_MEAN_S[table]
        )
        assert abs(mean_by_printed_weights / estimate - 1.0) > 1e-3


def test_delta1_and_delta2_have_the_values_of_erratum_13():
    true_a, estimated_a = load_cell("chen_mora").a, printed_values.tables_5_and_6()
    pack_a = printed_values.tables_8_to_10()
    for a, delta_1, delta_2 in (
        (true_a, 0.005013, 0.011156),
        (estimated_a, 0.009698, 0.017906),
        (pack_a, 0.009575, 0.017811),
    ):
        assert delta(a[8], a[9], a[7]) == pytest.approx(delta_1, abs=1e-6)
        assert delta(a[11], a[12], a[10]) == pytest.approx(delta_2, abs=1e-6)
