"""Charge that remains until the cut-off voltage, under a load with a given mean and peak.

The mean current discharges the pack and polarizes the RC pairs. The voltage reaches the cut-off at a peak, which adds a drop
over R_0 and over a part of R_1. The filter has learned the resistances at higher SOCs. Near empty they exceed those of the cell
file, so that they are increased towards SOC 0.

``s`` is a record of EKF_STATE, ``p`` of EKF_SETTINGS. Currents are positive on discharge.
"""

import math

from bms_estimator.kernels.cell_model.rc_ladder import BRANCHES
from bms_estimator.kernels.forecast.block_table import PEAK_FRACTION
from bms_estimator.kernels.forecast.constant_current import (
    branch_current,
    hypothesis_capacity,
    open_circuit_voltage,
    scaled_resistances,
)
from bms_estimator.kernels.forecast.draws import growth_fraction
from bms_estimator.kernels.forecast.projected_pack import RESISTANCE_MEAN
from bms_estimator.kernels.kalman_filter.records import SOC
from bms_estimator.model.arrays import Floats, Record
from bms_estimator.numba_cache import njit

MIN_LOAD_C = 0.05
"""Minimum mean current of the load, as a C-rate. It is used at rest and while charging."""
GROWTH = 0.5
"""Additional increase of all resistances from ``draws.GROWTH_SOC`` to SOC 0, as a fraction. The cell file has too small resistances
there, because few calibration captures contain loads near empty. Its effect is in docs/theory/available-power.md."""
SOC_STEP = 0.005
"""Step of the SOC towards empty. The crossing of the cut-off voltage is interpolated within a step."""


@njit(cache=True)
def mean_load(s: Record, p: Record) -> float:
    """Return the mean current of the last ten minutes [A], at least that of ``MIN_LOAD_C``."""
    return max(s.mean_a, MIN_LOAD_C * p.capacity_as / 3600.0)


@njit(cache=True)
def usable_charge(s: Record, p: Record, mean_a: float, peak_a: float, cutoff_v: float, ohm: Floats) -> float:
    """Return the charge until the voltage reaches the cut-off or the SOC reaches 0 [A s], the weighted mean over the hypotheses.

    Args:
        s: Record of EKF_STATE.
        p: Record of EKF_SETTINGS.
        mean_a: Mean current [A], above 0.
        peak_a: Peak current [A], at least ``mean_a``.
        cutoff_v: Voltage that ends the discharge [V].
        ohm: Scratch space of shape (RESISTANCES,).
    """
    total = charge_as = 0.0
    for q in range(s.count):
        weight = math.exp(s.ln_weight[q] - s.ln_weight[s.best])
        end_soc = soc_at_cutoff(s, p, q, mean_a, peak_a, cutoff_v, ohm)
        total += weight
        charge_as += weight * max(s.mean[q, SOC] - end_soc, 0.0) * hypothesis_capacity(s, p, q)
    return charge_as / total


@njit(cache=True)
def soc_at_cutoff(s: Record, p: Record, q: int, mean_a: float, peak_a: float, cutoff_v: float, ohm: Floats) -> float:
    """Return the SOC at which the voltage of hypothesis ``q`` reaches the cut-off; 0 if it does not."""
    soc = s.mean[q, SOC]
    above_v = peak_voltage(s, p, q, mean_a, peak_a, soc, ohm) - cutoff_v
    while soc > 0.0 and above_v > 0.0:
        step = min(SOC_STEP, soc)
        next_v = peak_voltage(s, p, q, mean_a, peak_a, soc - step, ohm) - cutoff_v
        if next_v <= 0.0:
            return soc - step * above_v / (above_v - next_v)
        soc, above_v = soc - step, next_v
    return soc


@njit(cache=True)
def peak_voltage(s: Record, p: Record, q: int, mean_a: float, peak_a: float, soc: float, ohm: Floats) -> float:
    """Return the voltage at a peak of the load at ``soc``, after the mean current until there [V]."""
    elapsed_s = (s.mean[q, SOC] - soc) * hypothesis_capacity(s, p, q) / mean_a
    scaled_resistances(s, p, q, soc, ohm)
    drop_v = ohm[0] * peak_a + PEAK_FRACTION * ohm[1] * (peak_a - mean_a)
    for k in range(BRANCHES):
        drop_v += ohm[1 + k] * branch_current(s, q, k, mean_a, elapsed_s)
    growth = GROWTH * (growth_fraction(soc) - growth_fraction(s.mean[q, SOC]))
    return open_circuit_voltage(s, p, q, soc, elapsed_s) - (RESISTANCE_MEAN + growth) * drop_v
