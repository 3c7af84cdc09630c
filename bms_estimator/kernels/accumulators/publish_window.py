"""Sums over the samples of a publish window, sums of charge and energy, and the decision whether the SOC is known.

The SOC is known if its estimate is certain enough to be shown, and to be compared with the limits of alarms.
"""

import math

import numpy as np

from bms_estimator.kernels.cell_model.current_interpolation import GAP_RATIO
from bms_estimator.model.arrays import Records
from bms_estimator.numba_cache import njit

MAX_KNOWN_STD = 0.15
"""Std of the SOC above which a known SOC becomes unknown. Its band of two std then covers more than half of the range."""
MIN_UNKNOWN_STD = 0.12
"""Std of the SOC below which an unknown SOC becomes known. The distance to ``MAX_KNOWN_STD`` prevents frequent changes."""
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
FLOW_SUMS = np.dtype(
    [
        ("charge_as", "f8"),  # charge since the last update of the totals, positive on discharge [A s]
        ("energy_ws", "f8"),  # energy since the last update of the totals, positive on discharge [W s]
        ("last_s", "f8"),  # time stamp of the last sample [s]
        ("last_a", "f8"),  # current of the last sample [A]
        ("last_w", "f8"),  # power of the last sample [W]
        ("step_s", "f8"),  # time between the last two samples [s]
        ("counted", "i8"),  # 1: a last sample exists
    ],
    align=True,
)
"""Running sums of charge and energy. All fields are 0 before the first sample."""


@njit(cache=True)
def is_soc_known(soc_std: float, was_known: bool) -> bool:
    """Return True if an SOC with this std is known. An SOC from coulomb counting alone has no std and counts as known.

    Args:
        soc_std: Std of the SOC; NaN without the identifier.
        was_known: Decision at the previous sample; False at the first one.
    """
    if soc_std > MAX_KNOWN_STD:
        return False
    return was_known or not soc_std >= MIN_UNKNOWN_STD


@njit(cache=True)
def known_rows(trace: Records, was_known: bool) -> np.ndarray:
    """Return ``is_soc_known`` at each row of dtype TRACE, shape (n,), bool."""
    known = np.empty(trace.shape[0], np.bool_)
    for j in range(trace.shape[0]):
        was_known = is_soc_known(trace[j].soc_std, was_known)
        known[j] = was_known
    return known


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


@njit(cache=True)
def accumulate_charge_energy(sums: Records, trace: Records, gap_s: float) -> None:
    """Integrate accepted samples by the trapezoidal rule, except over gaps and steps of a clock that was set back.

    Args:
        sums: Shape (1,), dtype FLOW_SUMS; updated in place.
        trace: Shape (n,), dtype TRACE.
        gap_s: Minimum duration of a gap [s]. A gap is also longer than ``GAP_RATIO`` previous steps.
    """
    s = sums[0]
    for j in range(trace.shape[0]):
        x = trace[j]
        power_w = x.voltage_v * x.current_a
        if s.counted:
            dt_s = x.time_s - s.last_s
            if 0.0 < dt_s <= max(gap_s, GAP_RATIO * s.step_s):
                s.charge_as += 0.5 * dt_s * (s.last_a + x.current_a)
                s.energy_ws += 0.5 * dt_s * (s.last_w + power_w)
            s.step_s = dt_s
        s.last_s, s.last_a, s.last_w, s.counted = x.time_s, x.current_a, power_w, 1
