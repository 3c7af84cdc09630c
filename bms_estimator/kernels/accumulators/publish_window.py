"""Sums over the samples of a publish window."""

import math

import numpy as np

from bms_estimator.kernels.accumulators.soc_certainty import is_soc_known
from bms_estimator.model.arrays import Records
from bms_estimator.numba_cache import njit

WINDOW_SUMS = np.dtype(
    [
        ("samples", "i8"),
        ("first_s", "f8"),  # time stamp of the first sample [s]
        ("voltage_v", "f8"),  # sum of the voltages [V]
        ("current_a", "f8"),  # sum of the currents [A]
        ("power_w", "f8"),  # sum of the powers [W]
        ("temperatures", "i8"),  # samples with a temperature
        ("temperature_c", "f8"),  # sum of the temperatures [C]
    ],
    align=True,
)
"""Running sums of a publish window. All fields are 0 before the first sample."""


@njit(cache=True)
def accumulate_window(sums: Records, trace: Records, soc_known: bool) -> bool:
    """Add accepted samples to the sums of a publish window. Return whether the SOC is known at the last one.

    Args:
        sums: Shape (1,), dtype WINDOW_SUMS; updated in place.
        trace: Shape (n,), dtype TRACE.
        soc_known: True if the SOC was known at the sample before.
    """
    s = sums[0]
    for j in range(trace.shape[0]):
        x = trace[j]
        if s.samples == 0:
            s.first_s = x.time_s
        s.samples += 1
        s.voltage_v += x.voltage_v
        s.current_a += x.current_a
        s.power_w += x.voltage_v * x.current_a
        if math.isfinite(x.temperature_c):
            s.temperatures += 1
            s.temperature_c += x.temperature_c
        soc_known = is_soc_known(x.soc_std, soc_known)
    return soc_known
