"""Limits of the alarms ``collapse_risk`` and ``weak_cell`` by the accepted rate of false alarms."""

import math
from collections.abc import Sequence

import numpy as np

USE_H_PER_MONTH = 60.0
"""Hours of use in a month, at two hours a day."""
COLLAPSE_FALSE_ALARMS = (
    (0.3, 0.66),
    (1.2, 0.62),
    (1.5, 0.54),
    (2.4, 0.50),
    (4.6, 0.38),
    (8.5, 0.26),
    (13.1, 0.18),
    (22.0, 0.10),
    (39.1, 0.05),
)
"""Pairs of the number of false alarms in 100 h of use and the limit: points of the measured curve of all discharges
(docs/theory/forecast.md)."""
WEAK_CELL_FALSE_ALARMS = ((0.12, 4.0), (0.23, 3.5), (0.35, 3.0), (0.58, 2.5), (1.16, 2.0), (4.77, 1.5))
"""Pairs of the number of false alarms in 100 h of discharges and the limit [std]: points of the measured curve of healthy
simulated banks (``make bank``, docs/pack/cells.md). At 4 std, no false alarm occurred in 859 h; the rate is that of one alarm."""
DEFAULT_WEAK_CELL_FALSE_ALARMS_PER_MONTH = 0.1
"""Default of the accepted number of false alarms in a month of 60 h of use. About one a year."""


def collapse_limit(false_alarms_per_month: float) -> float:
    """Return the probability of the cut-off at which the alarm is raised, 0..1.

    Args:
        false_alarms_per_month: Accepted number of false alarms in ``USE_H_PER_MONTH``, above 0.
    """
    return _limit_of_rate(COLLAPSE_FALSE_ALARMS, false_alarms_per_month)


def weak_cell_limit(false_alarms_per_month: float) -> float:
    """Return the deviation at which the alarm is raised [std].

    Args:
        false_alarms_per_month: Accepted number of false alarms in a month of 60 h of use, above 0.
    """
    return _limit_of_rate(WEAK_CELL_FALSE_ALARMS, false_alarms_per_month)


def _limit_of_rate(measured: Sequence[tuple[float, float]], false_alarms_per_month: float) -> float:
    """Return the limit of an alarm for an accepted rate of false alarms.

    The limit is interpolated over the logarithm of the rate. Outside the measured curve, the limit of the nearest end applies.

    Args:
        measured: Pairs of the number of false alarms in 100 h of use and the limit, with increasing numbers.
        false_alarms_per_month: Accepted number of false alarms in ``USE_H_PER_MONTH``, above 0.
    """
    rates, limits = zip(*measured, strict=True)
    in_100_h = 100.0 / USE_H_PER_MONTH * false_alarms_per_month
    return float(np.interp(math.log(in_100_h), np.log(rates), limits))
