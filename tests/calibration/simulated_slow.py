"""Simulated captures at C/20 of a cell with hysteresis and an ohmic resistance."""

import numpy as np

from bms_estimator.calibration.ocv.chen_mora_fit import chen_mora
from bms_estimator.model.arrays import SAMPLE
from bms_estimator.reports.thesis.printed_values import TABLE_1

CAPACITY_AH = 3.0
CURRENT_A = 0.05 * CAPACITY_AH
OHM = 0.04
"""Resistance of the cell [ohm]."""
STEP_S = 30.0
"""Sample period [s]."""
REST_S = 3600.0
"""Duration of each rest [s]."""
BRANCH_SOC = 0.02
"""Charge constant of the transition between the OCV after charge and the OCV after discharge [SOC]."""
KNEE_SOC, KNEE_V = 0.02, 0.6
"""SOC below which the voltage under load falls, and its fall at SOC 0 [V]."""


def true_v(soc):
    """Return the mean of the voltages after discharge and after charge [V]."""
    return chen_mora(np.array(TABLE_1), np.clip(soc, 0.0, 1.0))


def hysteresis_v(soc):
    """Return half of the difference between the OCV after charge and the OCV after discharge [V]."""
    return 0.01 + 0.02 * (1.0 - np.clip(soc, 0.0, 1.0))


def slow(
    directions=(1.0,), *, capacity_ah=CAPACITY_AH, temperature_c=np.nan, offset_v=0.0, moved_fraction=1.0, noise_v=2e-4
):
    """Return samples of discharges (1) and charges (-1) at C/20, in the order of ``directions``.

    An hour of rest precedes and follows each. Each moves ``moved_fraction`` of the capacity. ``offset_v`` is added to
    the OCV. The cell is full at the start if the first direction is a discharge, and empty otherwise.
    """
    samples_per_direction = int(moved_fraction * capacity_ah / CURRENT_A * 3600.0 / STEP_S)
    rest = np.zeros(int(REST_S / STEP_S))
    current_a = np.concatenate(
        [rest, *(np.r_[d * np.full(samples_per_direction, CURRENT_A), rest] for d in directions)]
    )
    samples = np.zeros(current_a.size, dtype=SAMPLE)
    samples["time_s"] = STEP_S * np.arange(current_a.size)
    samples["current_a"] = current_a
    soc = float(directions[0] > 0.0) - np.r_[0.0, np.cumsum(current_a[:-1])] * STEP_S / 3600.0 / capacity_ah
    # branch is 1 after charge and -1 after discharge. Before the first sample, the direction was the opposite one.
    branch, branch_at_sample = np.zeros(soc.size), float(directions[0])
    for i, soc_step in enumerate(np.diff(soc, prepend=soc[0])):
        branch_at_sample += (np.sign(soc_step) - branch_at_sample) * -np.expm1(-abs(soc_step) / BRANCH_SOC)
        branch[i] = branch_at_sample
    noise = noise_v * np.random.default_rng(0).standard_normal(soc.size)
    samples["voltage_v"] = true_v(soc) + offset_v + branch * hysteresis_v(soc) - OHM * current_a + noise
    samples["voltage_v"] -= KNEE_V * np.maximum(KNEE_SOC - soc, 0.0) / KNEE_SOC * (current_a != 0.0)
    samples["temperature_c"] = temperature_c
    return samples
