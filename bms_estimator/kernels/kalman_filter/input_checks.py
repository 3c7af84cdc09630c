"""Protection of the filter: innovation gate, detection of input faults, and restoration of the last good state.

``c`` is a record of CHECKS, ``n`` of COUNTERS, ``f`` of EKF_STATE, ``p`` of EKF_SETTINGS.
"""

import math

import numpy as np

from bms_estimator.kernels.cell_model.rc_ladder import REFERENCE_C
from bms_estimator.kernels.kalman_filter.equivalent_circuit import R_S, R_TL, R_TS, VARYING
from bms_estimator.kernels.kalman_filter.frozen_sensor import (
    FAST_S,
    FROZEN_S,
    MEAN_SAMPLES,
    OUTLIERS_S,
    UNOBSERVED_CHARGE_ERROR,
    VISIBLE_V,
    reference_series_resistance,
    rewind_to_freeze,
)
from bms_estimator.kernels.kalman_filter.hypotheses import initialize_filter, spawn_hypotheses
from bms_estimator.kernels.kalman_filter.ocv_correction import NODE_CORRELATION, node_error_scale
from bms_estimator.kernels.kalman_filter.records import B_SLOW, HYPOTHESES, LN_Q, NODE, NODES, OFFSET, STATES
from bms_estimator.kernels.kalman_filter.window import initialize_load_statistics, reset_window
from bms_estimator.model.arrays import Record
from bms_estimator.model.input_faults import InputFault
from bms_estimator.numba_cache import njit

GATE_STDS = 6.0
"""Limit of the innovation gate in std. A single sample beyond the gate is a glitch."""
GATE_SAMPLES = 5
"""Number of successive samples beyond the gate after which samples are accepted, because the cell has changed."""
GATE_S = 5.0
"""Duration of successive samples beyond the gate after which samples are accepted [s]."""
SNAPSHOT_S = 60.0
"""Interval at which the last good state is stored [s]."""
RESTORED_STD = 0.05
"""Additional std of the SOC after the last good state was restored."""
MAX_SOC_STD = 0.4
"""Maximum std of the SOC."""
SIGN_S, SIGN_SAMPLES = 100.0, 30.0
"""Minimum averaging time of the check of the current's sign, in s and in samples. Only time in which the current changes counts."""
MIN_EVIDENCE = 0.3
"""Minimum ``sign_evidence`` for a fault of the sign. It is 0 without data and 1 for a full average."""
WRONG_SIGN_SLOPE = 0.25
"""Minimum ratio of voltage to current changes for a fault of the sign, in multiples of R_s. A right sign gives -1, a wrong
sign gives 1."""
MIN_CORRELATION = 0.5
"""Minimum correlation of voltage and current changes for a fault of the sign. A right sign gives -1 and a wrong sign 1 if the
changes exceed the noise of the voltage. If the noise dominates, as with small loads of a large pack, the correlation over
``SIGN_SAMPLES`` is random, with a std of 0.13."""
MAX_CHANGE_RATIO = 5.0
"""Limit of a voltage change, in multiples of the change that the resistances explain, so that a glitch to zero does not
dominate the average."""
MANY_OUTLIERS = 5.0
"""Number of recent rejected samples above which the fault OUTLIERS begins."""
FEW_OUTLIERS = 1.0
"""Number of recent rejected samples up to which the fault OUTLIERS ends."""
OFFSET_STDS = 4.0
"""Limit of the offset for the fault OFFSET, in multiples of its initial std."""
CAPACITY_STDS = 2.0
"""Limit of the capacity for the fault CAPACITY, in multiples of its initial std."""
PRESENT_STDS = 3.0
"""Minimum of the states OFFSET and LN_Q for the faults OFFSET and CAPACITY, in multiples of the state's present std."""
CLEAR_FRACTION = 0.7
"""Fraction of its limit below which a fault ends (hysteresis)."""
MAX_OCV_BIAS_V = 0.12
"""Mean bias of one cell above which the OCV counts as wrong [V]. An OCV of the cell's chemistry has smaller errors."""
MAX_LEVEL_V = 0.03
"""Maximum deviation of a plateau's voltage from the OCV curve, for one cell [V]. Beyond it the measured voltage counts as
wrong. Makes of LFP differ by 11 mV."""
OCV_BIAS_S = 1800.0
"""Averaging time of the mean bias that shows a wrong OCV [s]."""
REINITIALIZATIONS_S = 5.0 * 3600.0
"""Time constant with which re-initializations of the SOC are discounted [s]."""
MAX_REINITIALIZATIONS = 4.0
"""Number of recent re-initializations of the SOC above which the OCV counts as wrong."""
TEMPERATURE_MARGIN_K = 5.0
"""Distance from the temperature range of the cell file for the fault TEMPERATURE [K]."""

SIGN_OF_CURRENT, OFFSET_BIT, CAPACITY, OCV, OUTLIERS, TEMPERATURE, VOLTAGE, CURRENT, PACK, LEVEL, *_FITTED = (
    int(bit) for bit in InputFault
)
FITTED_FAULTS = sum(_FITTED)
"""Faults that a fit of the pack's model shows. They remain until the next fit, or until a fault of ``UNUSABLE``."""
UNUSABLE = SIGN_OF_CURRENT | VOLTAGE | CURRENT
"""Faults during which the voltage is not used."""

CHECKS = np.dtype(
    [
        ("mean_a", "f8"),  # mean current of the samples in the last update of the filter [A]
        ("gated_in_row", "i8"),  # number of successive samples beyond the innovation gate
        ("gated_s", "f8"),  # duration of the successive samples beyond the gate [s]
        ("outliers", "f8"),  # number of rejected single samples, discounted with OUTLIERS_S
        ("slow_v", "f8"),  # running mean of the voltage [V]; 0: no sample yet
        ("slow_a", "f8"),  # running mean of the current [A]
        ("slower_v", "f8"),  # running mean of slow_v [V]
        ("slower_a", "f8"),  # running mean of slow_a [A]
        ("sign_evidence", "f8"),  # filled fraction of the averages change_v_a and change_a2, 0..1
        ("change_v_a", "f8"),  # running mean of fast voltage change times fast current change [V A]
        ("change_a2", "f8"),  # running mean of the squared fast current change [A^2]
        ("change_v2", "f8"),  # running mean of the squared fast voltage change, which includes the noise [V^2]
        ("last_v", "f8"),  # voltage of the previous sample [V]; 0: none
        ("last_a", "f8"),  # current of the previous sample [A]
        ("step_v", "f8"),  # smallest observed change of the voltage [V]; 0: none yet
        ("frozen_v_s", "f8"),  # time for which the voltage has been implausibly constant [s]
        ("frozen_a_s", "f8"),  # time for which the current has been implausibly constant [s]
        ("held_as", "f8"),  # charge since the last change of the voltage [A s]
        ("held_a", "f8"),  # current at the last change of the voltage [A]
        ("held_soc", "f8"),  # SOC at the last change of the voltage
        ("held_soc_std", "f8"),  # std of the SOC at the last change of the voltage
        ("same_s", "f8"),  # time since the last change of the current [s]
        ("noise_v", "f8"),  # mean change of the voltage between two samples while the current is constant [V]
        ("jump_v", "f8"),  # mean size of the jumps of the voltage while the current is constant [V]; 0: none yet
        ("jump_v2", "f8"),  # mean square of these jumps [V^2]
        ("same_soc", "f8"),  # SOC at the last change of the current
        ("same_soc_std", "f8"),  # std of the SOC at the last change of the current
        ("wrong_v", "f8"),  # running mean of the slow bias [V]
        ("searches", "f8"),  # number of recent increments of EKF_STATE.reopened, discounted with REINITIALIZATIONS_S
        ("seen_reopened", "i8"),  # value of EKF_STATE.reopened at the last check
        ("suspects", "i8"),  # bits of model.input_faults.InputFault
        ("good_mean", "f8", STATES),  # mean of the most likely hypothesis in the last good state
        ("good_covariance", "f8", (STATES, STATES)),  # covariance of that hypothesis
        ("good_soc", "f8"),  # SOC of the last good state
        ("good_soc_std", "f8"),  # std of the SOC of the last good state
        ("good_age_s", "f8"),  # time since the last good state was stored [s]
    ],
    align=True,
)
"""State of the input checks."""

COUNTERS = np.dtype(
    [
        ("gated", "i8"),  # samples rejected by the innovation gate
        ("reopened", "i8"),  # accepted runs of samples beyond the gate; not EKF_STATE.reopened
        ("reset", "i8"),  # restorations of the last good state because a value was not finite
    ],
    align=True,
)
"""Counters of the input checks."""


@njit(cache=True)
def passes_innovation_gate(
    c: Record,
    n: Record,
    f: Record,
    p: Record,
    e: Record,
    dt_s: float,
    change_a: float,
    current_a: float,
    voltage_v: float,
) -> bool:
    """Return True if the filter may use a sample.

    The voltage of a usable sample is within the gate, or many successive voltages are beyond the gate.

    Args:
        c: Record of CHECKS.
        n: Record of COUNTERS.
        f: Record of EKF_STATE.
        p: Record of EKF_SETTINGS.
        e: Record of EQUIVALENT.
        dt_s: Time since the previous sample [s].
        change_a: Change of the current since the previous sample [A].
        current_a: Current [A].
        voltage_v: Voltage [V].
    """
    difference_a = current_a - c.mean_a
    predicted_v = f.voltage_v - e.value[R_S] * difference_a
    # the voltage may have been measured before the current changed, and the RC pairs may already have followed the change
    jump_v = (e.value[R_S] + e.value[R_TS] + e.value[R_TL]) * max(abs(difference_a), abs(change_a))
    limit_v = GATE_STDS * math.sqrt(f.innovation_variance) + jump_v
    if abs(voltage_v - predicted_v) <= limit_v or dt_s > p.unmeasured_s:
        if c.gated_in_row > 0 and not gate_persists(c):
            c.outliers += c.gated_in_row
        c.gated_in_row, c.gated_s = 0, 0.0
        return True
    if gate_persists(c):
        return True
    c.gated_in_row += 1
    c.gated_s += dt_s
    if gate_persists(c):
        n.reopened += 1
        return True
    n.gated += 1
    return False


@njit(cache=True)
def gate_persists(c: Record) -> bool:
    """Return True if enough successive samples lie beyond the gate, so that they are not glitches."""
    return c.gated_in_row >= GATE_SAMPLES and c.gated_s >= GATE_S


@njit(cache=True)
def store_last_good_state(c: Record, f: Record) -> None:
    """Store the most likely hypothesis as the last good state."""
    for j in range(STATES):
        c.good_mean[j] = f.mean[f.best, j]
        for k in range(STATES):
            c.good_covariance[j, k] = f.covariance[f.best, j, k]
    c.good_soc, c.good_soc_std, c.good_age_s = f.soc, f.soc_std, 0.0


@njit(cache=True)
def restore_if_not_finite(c: Record, n: Record, f: Record, p: Record, dt_s: float) -> None:
    """Restore the last good state if a value of the filter is not finite; otherwise store the state at intervals."""
    total = (
        f.temperature_c
        + f.soc
        + f.soc_std
        + f.innovation_v
        + f.innovation_variance
        + f.mean_a
        + f.rms_a2
        + f.usual_a
        + f.usual_a2
    )
    for q in range(f.count):
        total += f.ln_weight[q] + f.fast_inflation[q] + f.slow_inflation[q]
        for j in range(STATES):
            total += f.mean[q, j] + f.covariance[q, j, j]
    if math.isfinite(total) and 1 <= f.count <= HYPOTHESES:
        c.good_age_s += dt_s
        if c.good_age_s >= SNAPSHOT_S:
            store_last_good_state(c, f)
        return
    f.best = 0
    for j in range(STATES):
        f.mean[0, j] = c.good_mean[j]
        for k in range(STATES):
            f.covariance[0, j, k] = c.good_covariance[j, k]
    if not math.isfinite(f.temperature_c):
        f.temperature_c, f.sensed = REFERENCE_C, 0  # the next temperature is used without smoothing
        f.weak = f.strong = f.hysteresis = 1.0  # Arrhenius factors at REFERENCE_C
    initialize_load_statistics(f, p, f.current_a)
    spawn_hypotheses(f, p, c.good_soc, math.sqrt(c.good_soc_std**2 + RESTORED_STD**2))
    reset_window(f)
    n.reset += 1


@njit(cache=True)
def track_current_sign(c: Record, p: Record, dt_s: float, current_a: float, voltage_v: float) -> None:
    """Average fast voltage change times fast current change, and the squares of both changes.

    The ratio of the product to the squared current change is -R_s if the sign is right. A ramp does not count as a change,
    because at the ends of the OCV curve the voltage changes slowly even under constant current.
    """
    if dt_s > FAST_S or c.slow_v == 0.0:  # the step is too long for a fast change, or this is the first sample
        c.slow_v = c.slower_v = voltage_v
        c.slow_a = c.slower_a = current_a
        return
    ohm = p.middle_ohm
    change_a = current_a - 2.0 * c.slow_a + c.slower_a
    limit_v = MAX_CHANGE_RATIO * ohm * abs(change_a)
    change_v = min(max(voltage_v - 2.0 * c.slow_v + c.slower_v, -limit_v), limit_v)
    share = dt_s / max(FAST_S, MEAN_SAMPLES * dt_s)
    c.slower_v += share * (c.slow_v - c.slower_v)
    c.slower_a += share * (c.slow_a - c.slower_a)
    c.slow_v += share * (voltage_v - c.slow_v)
    c.slow_a += share * (current_a - c.slow_a)
    visible = min(1.0, (ohm * change_a / (VISIBLE_V * p.series)) ** 2)
    weight = visible * dt_s / max(SIGN_S, SIGN_SAMPLES * dt_s)
    c.sign_evidence += weight * (1.0 - c.sign_evidence)
    c.change_v_a += weight * (change_v * change_a - c.change_v_a)
    c.change_a2 += weight * (change_a * change_a - c.change_a2)
    c.change_v2 += weight * (change_v * change_v - c.change_v2)


@njit(cache=True)
def unusable_input_bits(c: Record, p: Record) -> int:
    """Return the bits of faults that forbid the use of the voltage; 0: the voltage is usable."""
    if sign_is_wrong(c, p):
        return SIGN_OF_CURRENT
    return (VOLTAGE if c.frozen_v_s > FROZEN_S else 0) | (CURRENT if c.frozen_a_s > FROZEN_S else 0)


@njit(cache=True)
def sign_is_wrong(c: Record, p: Record) -> bool:
    """Return True if the voltage rises with a reported discharge. A present fault ends only when the voltage falls."""
    by_resistance_v_a = WRONG_SIGN_SLOPE * reference_series_resistance(p) * c.change_a2
    by_noise_v_a = MIN_CORRELATION * math.sqrt(c.change_v2 * c.change_a2)
    limit_v_a = 0.0 if c.suspects & SIGN_OF_CURRENT else max(by_resistance_v_a, by_noise_v_a)
    return c.change_v_a > limit_v_a and c.sign_evidence > MIN_EVIDENCE


@njit(cache=True)
def coast_without_voltage(c: Record, f: Record, p: Record, dt_s: float, current_a: float) -> None:
    """Process a sample without its voltage, during a fault of ``UNUSABLE``.

    Before a wrong sign of the current is found, it leads the filter to any SOC. While the reported current is frozen, the true
    current may be that of any typical load. When the fault ends, the SOC is re-initialized. After a fault of the current,
    offset, capacity and OCV are re-initialized, too, because the filter learned them from wrong currents until the fault was
    found. They remain if they were learned before (``learning_soc``).
    """
    error_soc = UNOBSERVED_CHARGE_ERROR * abs(current_a) * min(dt_s, p.unmeasured_s) / p.capacity_as
    if c.suspects & CURRENT:
        error_soc = p.load_mean_c * min(dt_s, p.unmeasured_s) / 3600.0
    elif c.suspects & SIGN_OF_CURRENT:
        error_soc = MAX_SOC_STD
    soc_std = math.sqrt((f.soc_std + error_soc) ** 2 + (f.window.unknown_as / p.capacity_as) ** 2)
    f.soc_std = min(soc_std, MAX_SOC_STD)
    f.window.unknown_as = 0.0
    f.step.phase = VARYING
    bits = unusable_input_bits(c, p)
    if bits:
        c.suspects = bits
        return
    soc_std = max(f.soc_std, RESTORED_STD)
    if c.suspects & (SIGN_OF_CURRENT | CURRENT) and f.learned_soc < p.learning_soc:
        initialize_filter(f, p, f.soc, f.current_a, f.temperature_c if f.sensed else math.nan)
    spawn_hypotheses(f, p, f.soc, soc_std)
    reset_window(f)
    c.suspects = 0


@njit(cache=True)
def update_input_faults(c: Record, f: Record, p: Record, dt_s: float) -> None:
    """Set and clear the bits of ``c.suspects`` after an update of the filter over ``dt_s``."""
    before = c.suspects
    c.outliers -= c.outliers * min(1.0, dt_s / OUTLIERS_S)
    bits = unusable_input_bits(c, p)
    if bits:
        if bits != SIGN_OF_CURRENT:  # a frozen input has spoiled the SOC since it froze
            rewind_to_freeze(c, f, p)
        c.suspects = bits
        return
    if c.outliers > (FEW_OUTLIERS if before & OUTLIERS else MANY_OUTLIERS):
        bits |= OUTLIERS
    x, cov = f.mean[f.best], f.covariance[f.best]
    offset_a = OFFSET_STDS * p.offset_c * p.capacity_as / 3600.0
    if is_significant_bias(x[OFFSET], cov[OFFSET, OFFSET], offset_a, before & OFFSET_BIT):
        bits |= OFFSET_BIT
    if is_significant_bias(x[LN_Q], cov[LN_Q, LN_Q], CAPACITY_STDS * p.capacity_std, before & CAPACITY):
        bits |= CAPACITY
    c.wrong_v += min(1.0, dt_s / OCV_BIAS_S) * (x[B_SLOW] - c.wrong_v)
    c.searches += f.reopened - c.seen_reopened - min(1.0, dt_s / REINITIALIZATIONS_S) * c.searches
    c.seen_reopened = f.reopened
    fraction = CLEAR_FRACTION if before & OCV else 1.0
    if abs(c.wrong_v) > fraction * MAX_OCV_BIAS_V * p.series or c.searches > fraction * MAX_REINITIALIZATIONS:
        bits = OCV | bits & OUTLIERS  # a wrong OCV also causes wrong estimates of offset and capacity
    outside_k = max(p.low_c - f.temperature_c, f.temperature_c - p.high_c)
    if f.sensed and outside_k > TEMPERATURE_MARGIN_K * (CLEAR_FRACTION if before & TEMPERATURE else 1.0):
        bits |= TEMPERATURE
    if f.exchanged:
        bits |= PACK
    c.suspects = bits | plateau_level_bit(f, p, before) | before & FITTED_FAULTS


@njit(cache=True)
def plateau_level_bit(f: Record, p: Record, before: int) -> int:
    """Return the bit of the fault LEVEL. Only the first pass of the OCV curve sets or clears it, while the level is learned.

    Args:
        f: Record of EKF_STATE.
        p: Record of EKF_SETTINGS.
        before: Bits of the faults before this update.
    """
    if p.node_correlation == NODE_CORRELATION or f.learned_soc >= p.learning_soc:
        return before & LEVEL  # no plateau or a fitted curve; or the first pass has ended, which resets the nodes
    middle = NODES // 2
    scale_v = node_error_scale(p, 0.5, 0.0)
    level_v = scale_v * f.mean[f.best, NODE + middle]
    variance_v2 = scale_v * scale_v * f.covariance[f.best, NODE + middle, NODE + middle]
    return LEVEL if is_significant_bias(level_v, variance_v2, MAX_LEVEL_V * p.series, before & LEVEL) else 0


@njit(cache=True)
def is_significant_bias(value: float, variance: float, expected: float, before: int) -> bool:
    """Return True if a bias exceeds its expected size significantly. ``before`` is not 0 if the fault is present."""
    fraction = CLEAR_FRACTION if before else 1.0
    return expected > 0.0 and abs(value) > fraction * max(expected, PRESENT_STDS * math.sqrt(variance))
