"""Sums of the charge and energy through the terminals."""

import numpy as np

from bms_estimator.kernels.cell_model.current_interpolation import GAP_RATIO
from bms_estimator.model.arrays import Records
from bms_estimator.numba_cache import njit

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
