"""The series resistance R_s from steps of the current: what the voltage jumps by, as everybody measures it.

A window of a second has the error of the whole model in it; between two samples around a step nothing of that changes but
the fastest branches, which are taken off. A step counts when the current is held before and behind it: in between,
voltage and current of one row may be of two moments.

``s`` is a record of EKF_STATE, ``p`` of EKF_SETTINGS.
"""

import math

from bms_estimator.kernels.cell_model.rc_ladder import BRANCHES, resistances
from bms_estimator.kernels.kalman_filter.ekf import HUBER
from bms_estimator.kernels.kalman_filter.equivalent_circuit import MAX_S
from bms_estimator.kernels.kalman_filter.records import LN_R, SOC
from bms_estimator.model.arrays import Record
from bms_estimator.numba_cache import njit

UNHELD, HELD, STEPPED = range(3)
MIN_C = 0.2
"""Minimum change of the current between two samples that counts as a step [C]."""
HELD_SHARE = 0.1
"""A current is held that changes by no more than this part of the (least) step."""
STEP_STD = 0.05
"""Std of ln of the resistance that one step shows, by kinetics and by timing errors of samples."""
FAST_STD = 0.5
"""Relative std of what the branches change by within the step."""
SHAPE_STD = 0.3
"""Std of a random walk of ln(R_s / R_0 of the file) over the whole range of SOC."""


@njit(cache=True)
def detect_current_step(s: Record, p: Record, dt_s: float, change_a: float, voltage_v: float) -> None:
    """Take one sample, after ``integrate_current``: the current changed by ``change_a`` [A] within ``dt_s`` [s]."""
    step, least_a = s.step, MIN_C * p.capacity_as / 3600.0
    before, step.phase = step.phase, UNHELD
    step.variance += SHAPE_STD**2 * abs(s.current_a) * dt_s / p.capacity_as
    if dt_s > MAX_S:
        return
    stepped_a = abs(s.current_a - step.current_a)
    if before == STEPPED and stepped_a >= least_a and abs(change_a) <= HELD_SHARE * stepped_a:
        update_r_s_from_step(s, p, voltage_v)
    elif before == HELD and abs(change_a) >= least_a:
        step.phase = STEPPED
    if abs(change_a) <= HELD_SHARE * least_a:
        step.phase = HELD
        step.current_a, step.voltage_v = s.current_a, voltage_v
        for k in range(BRANCHES):
            step.x_a[k] = s.x_a[k]


@njit(cache=True)
def update_r_s_from_step(s: Record, p: Record, voltage_v: float) -> None:
    """Learn of the step that ends with this voltage [V]."""
    x, step = s.mean[s.best], s.step
    resistances(x[SOC], p.weak_ohm, p.strong_ohm, s.weak, s.strong, s.ohm)
    change_a, fast_v = s.current_a - step.current_a, 0.0
    for k in range(BRANCHES):
        fast_v += math.exp(x[LN_R]) * s.ohm[1 + k] * (s.x_a[k] - step.x_a[k])
    jump_v = (step.voltage_v - voltage_v - fast_v) * math.copysign(1.0, change_a)
    if jump_v <= 0.0:
        return
    innovation = math.log(jump_v / abs(change_a) / s.ohm[0]) - step.ln_ratio
    total = step.variance + STEP_STD**2 + ((FAST_STD * fast_v) ** 2 + 2.0 * p.sensor_v2) / jump_v**2
    total = max(total, (innovation / HUBER) ** 2)
    gain = step.variance / total
    step.ln_ratio += gain * innovation
    step.variance -= gain * step.variance
