"""Remaining charge and energy at the present state and load."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bms_estimator.estimator import Estimator
from bms_estimator.estimator.identified_parameters import present_resistance, relative_capacity
from bms_estimator.kernels.cell_model import chen_mora


@dataclass(frozen=True)
class RemainingCharge:
    """Remaining charge and energy; NaN if unknown.

    Attributes:
        capacity_ah: Charge down to SOC 0 [Ah].
        energy_wh: Energy at the terminals down to SOC 0 at the present current [Wh].
    """

    capacity_ah: float = math.nan
    energy_wh: float = math.nan


def remaining_charge(estimator: Estimator, current_a: float) -> RemainingCharge:
    """Return the remaining charge and energy.

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
    open_circuit_wh = _mean_ocv(settings["ocv_v"], soc) * charge_ah
    lost_wh = load_a * _total_resistance(estimator, soc) * charge_ah
    return RemainingCharge(charge_ah, max(open_circuit_wh - lost_wh, 0.0))


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
