"""Series resistance R_s from voltage jumps at current steps.

The mean voltage of a window contains the error of the whole model. Between two samples around a current step, only the
fastest RC pairs change, and their change is subtracted. The current must be constant before and after a step, because
voltage and current of a sample during the step may be measured at different times.

``s`` is a record of EKF_STATE, ``p`` of EKF_SETTINGS.
"""

import math

from bms_estimator.kernels.cell_model.rc_ladder import BRANCHES, resistances
from bms_estimator.kernels.kalman_filter.ekf import HUBER
from bms_estimator.kernels.kalman_filter.equivalent_circuit import MAX_STEP_S
from bms_estimator.kernels.kalman_filter.records import LN_R, SOC
from bms_estimator.model.arrays import Record
from bms_estimator.numba_cache import njit

VARYING, CONSTANT, STEPPED = range(3)
"""Phases of ``detect_current_step``: the current varies, it is constant, or it has stepped from a constant current."""
MIN_STEP_C = 0.2
"""Minimum change of the current between two samples of a current step, as a C-rate."""
MAX_HELD_CHANGE = 0.1
"""Maximum change of a constant current, as a fraction of the step."""
STEP_STD = 0.05
"""Std of ln R_s from one step, due to kinetics and to timing errors of samples."""
FAST_STD = 0.5
"""Relative std of the RC pairs' change within the step."""
DRIFT_STD = 0.3
"""Std by which ln(R_s / R_0) drifts over the whole range of SOC, where R_0 is the series resistance of the cell file."""


@njit(cache=True)
def detect_current_step(s: Record, p: Record, dt_s: float, change_a: float, voltage_v: float) -> None:
    """Advance the phase by one sample, and update R_s at the end of a step. Call after ``integrate_current``.

    Args:
        s: Record of EKF_STATE.
        p: Record of EKF_SETTINGS.
        dt_s: Time since the previous sample [s].
        change_a: Change of the current since the previous sample [A].
        voltage_v: Voltage of the sample [V].
    """
    step, min_step_a = s.step, MIN_STEP_C * p.capacity_as / 3600.0
    previous_phase, step.phase = step.phase, VARYING
    step.variance += DRIFT_STD**2 * abs(s.current_a) * dt_s / p.capacity_as
    if dt_s > MAX_STEP_S:
        return
    stepped_a = abs(s.current_a - step.current_a)
    if previous_phase == STEPPED and stepped_a >= min_step_a and abs(change_a) <= MAX_HELD_CHANGE * stepped_a:
        update_r_s_from_step(s, p, voltage_v)
    elif previous_phase == CONSTANT and abs(change_a) >= min_step_a:
        step.phase = STEPPED
    if abs(change_a) <= MAX_HELD_CHANGE * min_step_a:
        step.phase = CONSTANT
        step.current_a, step.voltage_v = s.current_a, voltage_v
        for k in range(BRANCHES):
            step.x_a[k] = s.x_a[k]


@njit(cache=True)
def update_r_s_from_step(s: Record, p: Record, voltage_v: float) -> None:
    """Update R_s by the step that ends with ``voltage_v`` [V]."""
    x, step = s.mean[s.best], s.step
    # the parts with the low and with the high activation energy add to the resistance at the present temperature
    resistances(x[SOC], p.weak_ohm, p.strong_ohm, s.weak, s.strong, s.ohm)
    change_a, fast_v = s.current_a - step.current_a, 0.0
    for k in range(BRANCHES):
        fast_v += math.exp(x[LN_R]) * s.ohm[1 + k] * (s.x_a[k] - step.x_a[k])
    jump_v = (step.voltage_v - voltage_v - fast_v) * math.copysign(1.0, change_a)
    if jump_v <= 0.0:
        return
    innovation = math.log(jump_v / abs(change_a) / s.ohm[0]) - step.ln_ratio
    # 2: the jump is the difference of two voltage samples
    variance = step.variance + STEP_STD**2 + ((FAST_STD * fast_v) ** 2 + 2.0 * p.sensor_v2) / jump_v**2
    variance = max(variance, (innovation / HUBER) ** 2)
    gain = step.variance / variance
    step.ln_ratio += gain * innovation
    step.variance -= gain * step.variance
