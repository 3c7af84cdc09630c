"""Limit of the alarm ``weak_cell`` by the accepted rate of false alarms."""

from bms_estimator.settings.collapse_limit import limit_of_rate

FALSE_ALARMS = ((0.12, 4.0), (0.23, 3.5), (0.35, 3.0), (0.58, 2.5), (1.16, 2.0), (4.77, 1.5))
"""Pairs of the number of false alarms in 100 h of discharges and the limit [std]: points of the measured curve of healthy
simulated banks (``make bank``, docs/pack/cells.md). There was none at 4 std in 859 h; the rate is that of one."""
DEFAULT_WEAK_CELL_FALSE_ALARMS_PER_MONTH = 0.1
"""Default of the accepted number of false alarms in a month of 60 h of use. About one a year."""


def weak_cell_limit(false_alarms_per_month: float) -> float:
    """Return the deviation at which the alarm is raised [std].

    Args:
        false_alarms_per_month: Accepted number of false alarms in a month of 60 h of use, above 0.
    """
    return limit_of_rate(FALSE_ALARMS, false_alarms_per_month)
