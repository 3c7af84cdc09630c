"""Simulated low-rate captures of a cell with hysteresis and an ohmic resistance."""

import numpy as np

from bms_estimator.calibration.ocv.chen_mora_fit import chen_mora
from bms_estimator.model.sample import SAMPLE
from bms_estimator.reports.printed_values import TABLE_1

CAPACITY_AH, CURRENT_A, OHM, STEP_S = 3.0, 0.15, 0.04, 30.0


def true_v(soc):
    """Return the mean of the voltages after discharge and after charge [V]."""
    return chen_mora(np.array(TABLE_1), np.clip(soc, 0.0, 1.0))


def hysteresis_v(soc):
    return 0.01 + 0.02 * (1.0 - np.clip(soc, 0.0, 1.0))


def slow(directions=(1.0,), *, capacity_ah=CAPACITY_AH, temperature_c=np.nan, off_v=0.0, part=1.0, noise_v=2e-4):
    """An hour of rest after the other direction, then ``part`` of the cell out (1) or in (-1), in turn with rests between; at C/20.

    What starts with a discharge starts full, else empty.
    """
    samples_of_one = int(part * capacity_ah / CURRENT_A * 3600.0 / STEP_S)
    rest = np.zeros(int(3600.0 / STEP_S))
    current_a = np.concatenate([rest, *(np.r_[d * np.full(samples_of_one, CURRENT_A), rest] for d in directions)])
    samples = np.zeros(current_a.size, dtype=SAMPLE)
    samples["time_s"] = STEP_S * np.arange(current_a.size)
    samples["current_a"] = current_a
    soc = float(directions[0] > 0.0) - np.r_[0.0, np.cumsum(current_a[:-1])] * STEP_S / 3600.0 / capacity_ah
    branch, at = np.zeros(soc.size), float(directions[0])  # 1 after charge, -1 after discharge
    for i, moved in enumerate(np.diff(soc, prepend=soc[0])):
        at += (np.sign(moved) - at) * -np.expm1(-abs(moved) / 0.02)
        branch[i] = at
    noise = noise_v * np.random.default_rng(0).standard_normal(soc.size)
    samples["voltage_v"] = true_v(soc) + off_v + branch * hysteresis_v(soc) - OHM * current_a + noise
    samples["voltage_v"] -= 0.6 * np.maximum(0.02 - soc, 0.0) / 0.02 * (current_a != 0.0)  # empty within the last 2 %
    samples["temperature_c"] = temperature_c
    return samples
