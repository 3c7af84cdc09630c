"""Two RC pairs, (2.2)-(2.3) of the thesis, that are equivalent to the filter's ladder at the present SOC and temperature.

Ladder resistances with time constants up to ``SHORT_S`` add to R_ts, the slower ones to R_tl. Each time constant is the
geometric mean of the ladder's time constants, weighted by resistance.

R_s comes from voltage jumps at current steps, because the mean voltage of a window contains the error of the whole model.
Between two samples around a current step, only the fastest RC pairs change, and their change is subtracted. The current must be
constant before and after a step, because voltage and current of a sample during the step may be measured at different times.

``f`` and ``s`` are records of EKF_STATE, ``p`` is one of EKF_SETTINGS, ``e`` of EQUIVALENT.
"""

import math

import numpy as np

from bms_estimator.kernels.cell_model.rc_ladder import (
    BRANCHES,
    REFERENCE_C,
    RESISTANCES,
    TAU_S,
    TAUS,
    on_grid,
    resistances,
)
from bms_estimator.kernels.kalman_filter.ekf import HUBER
from bms_estimator.kernels.kalman_filter.noise import resistance_std
from bms_estimator.kernels.kalman_filter.ocv_correction import ocv_correction
from bms_estimator.kernels.kalman_filter.records import HYST, LN_R, LN_R0, OFFSET, SOC, X
from bms_estimator.model.arrays import Record
from bms_estimator.numba_cache import njit

R_S, R_TS, TAU_TS, C_TS, R_TL, TAU_TL, C_TL = range(7)
"""Indices of the circuit elements in ``value`` and ``ln_variance`` of a record of EQUIVALENT."""
SHORT_S = 60.0
"""Limit between the time constants published as R_ts C_ts and as R_tl C_tl [s]."""
SHORT_PAIRS = sum(tau_s < SHORT_S for tau_s in TAU_S)
"""Number of the ladder's RC pairs that belong to R_ts."""
SHAPE_STD = 0.03
"""Relative std of the cell file's series resistance over SOC and temperature after multiplication by one scale factor."""
MAX_STEP_S = 2.0
"""Maximum time between two samples that show a current step [s]."""
IDENTIFIED_FRACTION = 0.5
"""Fraction of its initial variance below which a scale of the resistances counts as identified."""
LN_TAUS = np.array([math.log(tau_s) for tau_s in TAU_S])
"""Logarithms of the ladder's time constants in seconds."""

EQUIVALENT = np.dtype(
    [
        ("ohm", "f8", RESISTANCES),  # resistances of the ladder, scaled by the filter
        ("value", "f8", 7),  # R_s, R_ts [ohm], tau_ts [s], C_ts [F], R_tl, tau_tl, C_tl
        ("ln_variance", "f8", 7),  # variance of the logarithm of each value
    ],
    align=True,
)
"""Circuit equivalent to the ladder at the present SOC and temperature."""

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
def write_equivalent_circuit(f: Record, p: Record, e: Record) -> None:
    """Write the resistances and two RC pairs at SOC and temperature of the most likely hypothesis to ``e``."""
    x, cov = f.mean[f.best], f.covariance[f.best]
    # each resistance is the sum of a part with weak and a part with strong temperature dependence
    resistances(x[SOC], p.weak_ohm, p.strong_ohm, f.weak, f.strong, e.ohm)
    file_r_0_ohm, r_k_factor = e.ohm[0], math.exp(x[LN_R])
    e.ohm[0] *= math.exp(x[LN_R0])
    for k in range(1, RESISTANCES):
        e.ohm[k] *= r_k_factor
    ln_ratio, variance = ln_r_s_ratio(f, p)
    # the measured rise belongs partly to R_s and partly to the RC pairs; R_s gets half of it, and the half is also its std
    half_ohm = 0.5 * branch_rise_within_sample(f, e)
    e.value[R_S] = file_r_0_ohm * math.exp(ln_ratio) + half_ohm
    e.ln_variance[R_S] = variance + (half_ohm / e.value[R_S]) ** 2
    write_rc_pair(e, 0, SHORT_PAIRS, R_TS, cov[LN_R, LN_R], p.r_std)
    write_rc_pair(e, SHORT_PAIRS, BRANCHES, R_TL, cov[LN_R, LN_R], p.r_std)


@njit(cache=True)
def ln_r_s_ratio(f: Record, p: Record) -> tuple[float, float]:
    """Return ln of the ratio of R_s to R_0 in the file at equal SOC and temperature, and its variance.

    The ratio comes from current steps if they have determined it, otherwise from the filter.
    """
    if r_s_identified_by_steps(f, p):
        return f.step.ln_ratio, f.step.variance + SHAPE_STD**2
    return f.mean[f.best, LN_R0], f.covariance[f.best, LN_R0, LN_R0] + SHAPE_STD**2


@njit(cache=True)
def write_rc_pair(e: Record, first: int, end: int, at: int, scale_variance: float, r_std: float) -> None:
    """Write R, tau and C equivalent to the ladder's RC pairs ``first`` to ``end`` - 1 to ``e.value[at : at + 3]``.

    The resistances have a common scale with variance ``scale_variance`` and independent relative errors ``r_std``, which
    cause an error of tau.
    """
    ohm = ln_tau = 0.0
    for k in range(first, end):
        ohm += e.ohm[1 + k]
        ln_tau += e.ohm[1 + k] * LN_TAUS[k]
    ln_tau /= ohm
    # squared sensitivities of ln R, ln tau and ln C to the errors of the ladder's resistances
    by_r = by_tau = by_c = 0.0
    for k in range(first, end):
        share, deviation = e.ohm[1 + k] / ohm, LN_TAUS[k] - ln_tau
        by_r += share**2
        by_tau += (share * deviation) ** 2
        by_c += (share * (deviation - 1.0)) ** 2
    variance = r_std * r_std
    e.value[at], e.ln_variance[at] = ohm, scale_variance + variance * by_r
    e.value[at + 1], e.ln_variance[at + 1] = math.exp(ln_tau), variance * by_tau
    e.value[at + 2], e.ln_variance[at + 2] = math.exp(ln_tau) / ohm, scale_variance + variance * by_c


@njit(cache=True)
def branch_rise_within_sample(f: Record, e: Record) -> float:
    """Return the rise of the RC pairs within one sample after a current step [ohm].

    Measurements cannot divide this rise between R_s and the RC pairs.
    """
    ohm = 0.0
    # ``decay_s`` is the interval of the last samples
    for k in range(BRANCHES):
        ohm += e.ohm[1 + k] * (1.0 - math.exp(-min(f.decay_s, MAX_STEP_S) / TAUS[k]))
    return ohm


@njit(cache=True)
def scale_is_identified(f: Record, p: Record, j: int) -> bool:
    """Return True if data have determined the scale of the resistances in state ``j``: LN_R0 for R_0, LN_R for the others."""
    return f.covariance[f.best, j, j] < IDENTIFIED_FRACTION * resistance_std(f, p) ** 2


@njit(cache=True)
def r_s_identified_by_steps(f: Record, p: Record) -> bool:
    """Return True if current steps have determined R_s."""
    return f.step.variance < IDENTIFIED_FRACTION * resistance_std(f, p) ** 2


@njit(cache=True)
def open_circuit(f: Record, p: Record, e: Record, current_a: float, voltage_v: float) -> float:
    """Return the OCV at 25 C that follows from the measured voltage by (2.4) of the thesis [V].

    Overpotential, hysteresis, learned correction and temperature dependence of the OCV are subtracted.
    """
    x = f.mean[f.best]
    e_o = voltage_v + e.ohm[0] * (current_a - x[OFFSET])
    for k in range(BRANCHES):
        # x_a: filtered current of a pair since switch-on; X: estimated remainder, due to the load before switch-on
        e_o += e.ohm[1 + k] * (f.x_a[k] + x[X + k])
    e_o -= f.hysteresis * on_grid(x[SOC], p.hysteresis_v) * x[HYST] + ocv_correction(p, x, x[SOC])
    return e_o - (f.temperature_c - REFERENCE_C) * on_grid(x[SOC], p.per_kelvin_v)


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
