"""Lemma 4.1.3 and (2.11), (2.12) against digits worked out by hand from the printed bounds and weights."""

import pytest

from bms_estimator.kernels.margins import delta
from bms_estimator.model.cell import load_cell
from bms_estimator.reports import printed

TABLE_4 = {1: 0.2995, 3: 0.04485, 6: 0.04990, 13: 0.1495, 15: 0.06970}
"""(100 upper + lower) / 101."""
TABLES_5_AND_10 = {
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
"""(x upper + y lower) / (x + y); a8 with the weights of E4, a5 of Table 10 as E5."""
INFERRED = {("5", 7): 759.3, ("10", 7): 759.3, ("10", 4): 6.250}
"""With the weights of E24."""
PRINTED_ESTIMATES = {
    "5": (0.5555, 29.9996, 0.0557, 5.6095, 149.9983, 0.0630, 759.2573, 10.6712, 684.61, 5999.6, 27.5014, 3666.6),
    "10": (0.5505, 30.0475, 0.0551, 6.2585, 30.0, 0.0551, 760.2266, 10.7686, 685.7457, 6036.4, 27.5422, 3696.0),
}
WORST_PERCENT = {"5": 0.075, "10": 0.28}
"""a6 of Table 5 has three digits; a8 of Table 10."""


def digits(value):
    return float(f"{value:.4g}")


@pytest.mark.parametrize(("index", "expected"), TABLE_4.items())
def test_limits_of_table_4_to_four_digits(index, expected):
    upper, lower, *_ = printed.TABLE_4[index]
    x, y = printed.TABLE_4_WEIGHTS
    assert digits((x * upper + y * lower) / (x + y)) == expected


@pytest.mark.parametrize("cell", ["chen_mora", "thunder_power_6s"])
@pytest.mark.parametrize(("index", "expected"), TABLES_5_AND_10.items())
def test_limits_of_tables_5_and_10_to_four_digits(cell, index, expected):
    for table in ("5", "10"):
        assert digits(printed.bounds(table, index).limit) == INFERRED.get((table, index), expected)
    assert digits(load_cell(cell).bounds(index).limit) == expected


def test_printed_weights_of_a8_have_another_limit():
    upper, lower, x, y = printed.BOUNDS[8]
    assert (upper, lower, x, y) == (30, 1, 50, 10)
    assert digits((x * upper + y * lower) / (x + y)) == 25.17  # E4


@pytest.mark.parametrize("index", range(1, 13))
@pytest.mark.parametrize("table", ["5", "10"])
def test_printed_estimates_are_means_from_the_first_sample_on(table, index):
    """Bounds, weights and initial values alone, no data, give what Tables 5 and 10 print (E3)."""
    estimate = PRINTED_ESTIMATES[table][index - 1]
    mean = printed.mean_from_start(table, index)
    if (table, index) == ("10", 5):
        assert mean == pytest.approx(150.0, rel=1e-4)  # E5: printed 30
    else:
        assert mean == pytest.approx(estimate, rel=1e-2 * WORST_PERCENT[table])


def test_worst_of_the_means():
    for table, worst in WORST_PERCENT.items():
        assert printed.worst_mean_percent(table) == pytest.approx(worst, abs=0.005)


def test_weights_of_e24_give_the_printed_estimates_and_the_printed_weights_do_not():
    for table, index, mean, estimate in (
        ("5", 7, 759.2536, 759.2573),
        ("10", 7, 760.1875, 760.2266),
        ("10", 4, 6.2583, 6.2585),
    ):
        assert printed.mean_from_start(table, index) == pytest.approx(mean, rel=1e-5)
        assert mean == pytest.approx(estimate, rel=1e-4)
        upper, lower, x, y = printed.BOUNDS[index]
        limit = (x * upper + y * lower) / (x + y)
        as_printed = limit + (printed.initial(table, index) - limit) / ((x + y) * printed.START_MEAN_S[table])
        assert abs(as_printed / estimate - 1.0) > 1e-3


def test_deltas_of_e13():
    true, estimated, pack = load_cell("chen_mora").a, printed.tables_5_and_6(), printed.tables_8_to_10()
    for a, delta_1, delta_2 in (
        (true, 0.005013, 0.011156),
        (estimated, 0.009698, 0.017906),
        (pack, 0.009575, 0.017811),
    ):
        assert delta(a[8], a[9], a[7]) == pytest.approx(delta_1, abs=1e-6)
        assert delta(a[11], a[12], a[10]) == pytest.approx(delta_2, abs=1e-6)
