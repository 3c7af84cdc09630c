"""Remaining charge, energy and time at the present state and load."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bms_estimator.estimator import Estimator
from bms_estimator.estimator.identified_parameters import present_resistance, relative_capacity
from bms_estimator.kernels.cell_model import chen_mora

MAX_TIME_H = 1000.0
"""Maximum published time to empty or full [h]. A current that would take longer counts as zero."""


@dataclass(frozen=True)
class RemainingCharge:
    """Remaining charge, energy and time; NaN if unknown.

    Attributes:
        capacity_ah: Charge down to SOC 0 [Ah].
        usable_ah: Charge down to max(delta1, delta2), the SOC below which a capacitance of the model is negative [Ah].
        energy_wh: Energy at the terminals down to SOC 0 at the present current [Wh].
        time_to_empty_s: Time to SOC 0 at the present current [s].
        time_to_full_s: Time to SOC 1 at the present current [s].
    """

    capacity_ah: float = math.nan
    usable_ah: float = math.nan
    energy_wh: float = math.nan
    time_to_empty_s: float = math.nan
    time_to_full_s: float = math.nan


def remaining_charge(estimator: Estimator, current_a: float) -> RemainingCharge:
    """Return the remaining charge, energy and time.

    Args:
        estimator: Estimator; read only.
        current_a: Present current [A], positive on discharge.
    """
    state, settings = estimator.state[0], estimator.settings[0]
    if not state["started"] or math.isnan(state["soc"]):
        return RemainingCharge()
    soc, load_a = float(state["soc"]), max(current_a, 0.0)
    capacity_ah = float(settings["capacity_as"]) / 3600.0
    if estimator.identifying:
        capacity_ah *= relative_capacity(estimator.record[0]).value
    charge_ah = soc * capacity_ah
    usable_ah = max(soc - max(state["delta_1"], state["delta_2"]), 0.0) * capacity_ah
    open_circuit_wh = _mean_ocv(settings["ocv_v"], soc) * charge_ah
    lost_wh = load_a * _total_resistance(estimator, soc) * charge_ah
    to_empty_s = _duration_s(charge_ah, load_a, capacity_ah)
    to_full_s = _duration_s(capacity_ah - charge_ah, -current_a, capacity_ah)
    return RemainingCharge(charge_ah, usable_ah, max(open_circuit_wh - lost_wh, 0.0), to_empty_s, to_full_s)


def _duration_s(charge_ah: float, current_a: float, capacity_ah: float) -> float:
    """Return the time in which the current moves ``charge_ah`` [s]; NaN if the current is negligible for ``capacity_ah``."""
    return 3600.0 * charge_ah / current_a if current_a * MAX_TIME_H > capacity_ah else math.nan


def _mean_ocv(ocv_v: NDArray[np.float64], soc: float) -> float:
    """Return the mean open-circuit voltage between SOC 0 and ``soc`` [V], rounded to a node of the OCV grid."""
    below = ocv_v[: max(round(soc * (ocv_v.size - 1)), 1) + 1]
    return float((below.sum() - 0.5 * (below[0] + below[-1])) / (below.size - 1))


def _total_resistance(estimator: Estimator, soc: float) -> float:
    """Return the total DC resistance, with all RC pairs in steady state [ohm]."""
    if estimator.identifying:
        return present_resistance(estimator.record[0])
    a = estimator.state[0]["a"]
    return float(chen_mora.r_s(soc, a) + chen_mora.r_ts(soc, a) + chen_mora.r_tl(soc, a))
