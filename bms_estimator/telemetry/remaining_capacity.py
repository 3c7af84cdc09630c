"""Remaining charge at the present state."""

import math

from bms_estimator.estimator import Estimator
from bms_estimator.estimator.identified_parameters import relative_capacity


def remaining_capacity_ah(estimator: Estimator) -> float:
    """Return the charge down to SOC 0 [Ah]; NaN before the first sample.

    Args:
        estimator: Estimator; read only.
    """
    state = estimator.state[0]
    if not state["started"] or math.isnan(state["soc"]):
        return math.nan
    return float(state["soc"]) * full_capacity_ah(estimator)


def full_capacity_ah(estimator: Estimator) -> float:
    """Return the learned capacity [Ah], after a sample; without the identifier the declared one."""
    ratio = relative_capacity(estimator.record[0]).value if estimator.identifying else 1.0
    return ratio * float(estimator.settings["capacity_as"][0]) / 3600.0
