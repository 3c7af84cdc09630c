"""Remaining charge at the present state."""

import math

from bms_estimator.estimator import Estimator
from bms_estimator.estimator.identified_parameters import relative_capacity


def remaining_capacity_ah(estimator: Estimator) -> float:
    """Return the charge down to SOC 0 [Ah]; NaN before the first sample.

    Args:
        estimator: Estimator; read only.
    """
    state, settings = estimator.state[0], estimator.settings[0]
    if not state["started"] or math.isnan(state["soc"]):
        return math.nan
    capacity_ah = float(settings["capacity_as"]) / 3600.0
    if estimator.identifying:
        capacity_ah *= relative_capacity(estimator.record[0]).value
    return float(state["soc"]) * capacity_ah
