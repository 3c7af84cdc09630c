"""Numbers as printed in the thesis, including misprints.

Numbers in parentheses are sections and equations of the thesis, and E1 to E37 are its errata (``errata``).
"""

import numpy as np

from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell_sections import Bounds

CHEN_MORA_ROUNDED = (0.30, 29.0, 0.04, 6.0, 155.0, 0.04, 752.0, 13.0, 703.0, 6050.0, 27.0, 4475.0, 0.1, 24.0, 0.07)
"""Rounded a1..a15 of Chen and Mora, which are also the initial values of Tables 2 and 3."""

TABLE_1 = (1.031, 35.0, 3.685, 0.2156, 0.1178, 0.3201)
"""Parameters a16..a21 of the open-circuit voltage (2.10) in the simulations."""

TABLE_2 = (
    0.7607,
    29.4607,
    0.5007,
    6.4607,
    155.4607,
    0.5007,
    752.4607,
    13.4607,
    703.4607,
    6050.4607,
    27.4607,
    4475.4,
    0.5607,
    24.4607,
    0.5307,
)
"""Estimates of a1..a15, the coefficients of the elements (2.5)-(2.9), by scheme 1."""
TABLE_2_ERROR = (153, 1.5, 1151, 7.67, 0.297, 1151.75, 0.0612, 3.54, 0.0655, 0.00761, 1.7, 0.0089, 460.7, 1.919, 658.14)
"""Errors of a1..a15, scheme 1 [%]."""
TABLE_2_SHIFT = 0.4607
"""Common change of a1..a15 in scheme 1."""

TABLE_3 = (
    0.3,
    29.6182,
    0.04,
    6.6182,
    155.6182,
    0.04,
    752.6182,
    13.6182,
    703.6182,
    6050.6,
    27.6182,
    4475.6,
    0.1,
    24.6182,
    0.07,
)
"""Estimates of a1..a15 by scheme 2."""
TABLE_3_ERROR = (0, 2.13, 0, 10.3, 0.34, 0, 0.0822, 4.755, 0.0879, 0.00991, 2.289, 0.0134, 0, 2.575, 0)
"""Errors of a1..a15, scheme 2 [%]."""
TABLE_3_SHIFT = 0.6182
"""Common change of all parameters outside ``SMALL`` in scheme 2."""
SMALL = (1, 3, 6, 13, 15)
"""Indices of the small parameters, the set q of the thesis. Scheme 2 returns them to their initial values, scheme 3 to
their limits."""

TABLE_4 = {
    1: (0.30, 0.25, 0.2946, 0.3208, 8.16),
    3: (0.045, 0.03, 0.0443, 0.04669, 5.11),
    6: (0.05, 0.04, 0.0491, 0.04984, 1.5),
    13: (0.15, 0.1, 0.1475, 0.1562, 5.569),
    15: (0.07, 0.04, 0.0489, 0.04669, 4.7),
}
"""Upper bound, lower bound, estimate, desired value and error [%] by index."""
TABLE_4_WEIGHTS = (100.0, 1.0)
"""Weights lambda_x and lambda_y of Table 4 [1/s]."""

BOUNDS = {
    1: (1.0, 0.1, 50.0, 50.0),
    2: (50.0, 10.0, 50.0, 50.0),
    3: (0.1, 0.01, 50.0, 50.0),
    4: (10.0, 1.0, 50.0, 50.0),
    5: (200.0, 100.0, 50.0, 50.0),
    6: (0.1, 0.01, 50.0, 50.0),
    7: (1000.0, 500.0, 60.0, 55.0),
    8: (30.0, 1.0, 50.0, 10.0),
    9: (800.0, 500.0, 80.0, 50.0),
    10: (7000.0, 5000.0, 10.0, 10.0),
    11: (50.0, 5.0, 50.0, 50.0),
    12: (5000.0, 3000.0, 10.0, 20.0),
}
"""Upper bound, lower bound, and their weights lambda_x and lambda_y [1/s] in Tables 5 and 10 by index, as printed (a8:
erratum 4).

The limit of a parameter is the mean of its bounds with these weights (Lemma 4.1.3), and the sum of the weights is its
rate.
"""
A8_WEIGHTS = (10.0, 20.0)
"""Weights that belong to the printed estimates of a8 (erratum 4)."""
A5 = 150.0
"""a5 of Table 10, printed as 30 (erratum 5)."""

TABLE_5 = {
    1: (180.0, 0.5555, 0.3208, 42.25),
    2: (17.0, 29.9996, 29.14, 2.86),
    3: (24.0, 0.0557, 0.04669, 16.17),
    4: (3600.0, 5.6095, 6.603, 17.71),
    5: (93.0, 149.9983, 155.2, 3.47),
    6: (264.0, 0.0630, 0.04984, 20.88),
    7: (510.0, 759.2573, 752.9, 0.837),
    8: (78.0, 10.6712, 13.51, 26.6),
    9: (451.0, 684.61, 703.6, 2.77),
    10: (420.0, 5999.6, 6056.0, 0.94),
    11: (162.0, 27.5014, 27.12, 1.386),
    12: (363.0, 3666.6, 4475.0, 22.04),
}
"""Initial value, estimate, desired value and error [%] by index."""

TABLE_6 = {13: (0.1562, 0.4963, "2.17"), 14: (24.37, 33.07, "35.6"), 15: (0.07446, 0.06546, "0.06546")}
"""Desired value, estimate and error as printed, by index."""

TABLE_7 = {"R_ts": 8.61, "R_tl": 3.54, "C_tl": 1.326, "C_ts": 19.166, "R_ts C_ts": 1.9225, "R_tl C_tl": 0.0384}
"""Absolute average estimation error [%]."""

TABLE_8 = (5.112, 40.955, 22.195, 1.9215, 1.7590, 3.0435)
"""Estimates a16..a21 of the experiments."""
TABLE_9 = (0.0439, 59.07, 0.2246)
"""Estimates a13..a15 of the experiments."""
TABLE_10 = {
    1: (1800.0, 0.5505),
    2: (174000.0, 30.0475),
    3: (240.0, 0.0551),
    4: (36000.0, 6.2585),
    5: (9300.0, 30.0),
    6: (264.0, 0.0551),
    7: (4512000.0, 760.2266),
    8: (78000.0, 10.7686),
    9: (5100000.0, 685.7457),
    10: (36300000.0, 6036.4),
    11: (162000.0, 27.5422),
    12: (42000000.0, 3696.0),
}
"""Initial value and estimate by index."""
TABLE_11 = {
    "25 ohm": 0.234,
    "50 ohm": 0.2697,
    "12.5 ohm": 0.3390,
    "50 W bulb": 0.1805,
    "constant steps": 0.4744,
    "variable steps": 0.4645,
}
"""Average error of the output voltage [%] by load."""
MAX_CONSTANT = 0.9
"""Largest error of the output voltage under constant loads (5.3.1) [%]."""
MAX_CONSTANT_STEPS = 0.8
"""Largest error of the output voltage under constant steps (5.3.2) [%]."""
MAX_STEPS = 1.5
"""Largest error of the output voltage under variable steps (5.3.2) [%]."""
USUAL_STEPS = 0.1
"""Error under steps "most of the time" (5.3.2) [%]."""
TABLE_12 = {"dynamic": 4.5, "static": 6.44}
"""Mean errors of the dynamic and the static model in simulation, as printed."""
TABLE_13 = {"dynamic": 0.003, "static": 0.358}
"""Mean errors of the dynamic and the static model in the experiment, as printed."""

CURRENTS_A = {"25 ohm": 0.860, "50 ohm": 0.416, "12.5 ohm": 1.741, "50 W bulb": 3.652}
"""Average current of each load (5.2.1) [A]."""
RESISTORS_OHM = {"25 ohm": 25.0, "50 ohm": 50.0, "12.5 ohm": 12.5}
"""Resistances of the loads (5.1) [ohm]."""
SENSOR_RANGE_V = 25.0
"""Range of the voltage sensor (5.1) [V]."""
BULB_W = 50.0
"""Rated power of one bulb (5.1) [W]."""
RUN_HOURS = (4.0, 16.0)
"""Minimum and maximum duration of the experimental runs (5.2) [h]."""

INFERRED_WEIGHTS = {
    "5": {7: (196.0, 182.0), 8: (15.0, 30.0), 10: (20.0, 20.0), 11: (150.0, 150.0), 12: (50.0, 100.0)},
    "10": {4: (70.0, 50.0), 7: (70.0, 65.0), 8: A8_WEIGHTS},
}
"""Weights by table and index that give the printed estimate, if the printed weights do not (errata 4, 24, 32)."""
START_MEAN_S = {"5": 328.3, "10": 36_000.0}
"""Time from the first sample, by table, over which the means (3.19) of a1..a12 equal the printed estimates [s]."""
FREE_PARAMETERS = {"5": 8, "10": 7}
"""Number of parameters fitted to the estimates of Tables 5 and 10.

The fitted parameters are the time ``START_MEAN_S``, the sum of each pair in ``INFERRED_WEIGHTS``, and the ratio of each
pair whose ratio differs from the printed one: 1 + 5 + 2 for Table 5, 1 + 3 + 3 for Table 10.
"""
DECIMALS_5 = {1: 4, 2: 4, 3: 4, 4: 4, 5: 4, 6: 4, 7: 4, 8: 4, 9: 2, 10: 1, 11: 4, 12: 1}
"""Decimals of the estimates of Table 5."""


def bounds(table: str, index: int) -> Bounds:
    """Return the printed bounds of a parameter in Table 5 or 10, with the weights of ``INFERRED_WEIGHTS``."""
    upper, lower, *printed_weights = BOUNDS[index]
    weight_upper, weight_lower = INFERRED_WEIGHTS[table].get(index, printed_weights)
    return Bounds(
        upper=upper, lower=lower, weight_upper=weight_upper, weight_lower=weight_lower, initial=initial(table, index)
    )


def initial(table: str, index: int) -> float:
    """Return the initial value of a_i in Table 5 or 10."""
    return TABLE_5[index][0] if table == "5" else TABLE_10[index][0]


def mean_from_start(table: str, index: int) -> float:
    """Return the mean (3.19) of a_i(t) over the first ``START_MEAN_S`` of Table 5 or 10 at e = 0.

    At e = 0, a_i(t) is the exponential (4.5) from the initial value to the limit.
    """
    b = bounds(table, index)
    # the factor 1 - e^(-rate T) of the mean is 1, because rate T is above 10^4
    return b.limit + (initial(table, index) - b.limit) / (b.rate * START_MEAN_S[table])


def implied_rates(index: int) -> tuple[float, float]:
    """Return the range of the rate in which ``mean_from_start`` rounds to the printed estimate of Table 5 [1/s]."""
    half_digit = 0.5 * 10.0 ** -DECIMALS_5[index]
    b, estimate = bounds("5", index), TABLE_5[index][1]
    rates = [
        (initial("5", index) - b.limit) / (START_MEAN_S["5"] * (estimate + error - b.limit))
        for error in (-half_digit, half_digit)
    ]
    return min(rates), max(rates)


def worst_mean_percent() -> float:
    """Return the largest relative difference between ``mean_from_start`` and Table 10; a5 as in erratum 5 [%]."""
    estimates = {i: row[1] for i, row in TABLE_10.items()} | {5: A5}
    return max(100.0 * abs(mean_from_start("10", i) / estimate - 1.0) for i, estimate in estimates.items())


def tables_5_and_6() -> Floats:
    """Return the printed estimates a1..a15 of Tables 5 and 6 at index 1..15, shape (16,)."""
    a = np.zeros(16)
    for index, (_, estimate, _, _) in TABLE_5.items():
        a[index] = estimate
    for index, (_, estimate, _) in TABLE_6.items():
        a[index] = estimate
    return a


def tables_8_to_10() -> Floats:
    """Return the printed estimates a1..a21 of Tables 8 to 10 at index 1..21, shape (22,), with a5 = 150 (E5)."""
    a = np.zeros(22)
    for index, (_, estimate) in TABLE_10.items():
        a[index] = estimate
    a[5] = A5
    a[13:16], a[16:22] = TABLE_9, TABLE_8
    return a
