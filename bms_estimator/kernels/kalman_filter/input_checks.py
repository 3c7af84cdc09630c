"""Protection of the filter: an innovation gate, a watch on its input, the last good state.

``c`` is a record of CHECKS, ``n`` of COUNTERS, ``f`` of EKF_STATE, ``p`` of EKF_SETTINGS.
"""

import math

import numpy as np

from bms_estimator.kernels.cell_model.rc_ladder import REFERENCE_C
from bms_estimator.kernels.kalman_filter.equivalent_circuit import R_S, R_TL, R_TS
from bms_estimator.kernels.kalman_filter.frozen_sensor import (
    FAST_S,
    FROZEN_S,
    OUTLIERS_S,
    UNCOUNTED,
    VISIBLE_V,
    reference_series_resistance,
    rewind_to_freeze,
)
from bms_estimator.kernels.kalman_filter.gap_charge import initialize_load_statistics
from bms_estimator.kernels.kalman_filter.hypotheses import initialize_filter, spawn_hypotheses
from bms_estimator.kernels.kalman_filter.records import B_SLOW, HYPOTHESES, LN_Q, OFFSET, STATES
from bms_estimator.kernels.kalman_filter.step_resistance import UNHELD
from bms_estimator.kernels.kalman_filter.window import reset_window
from bms_estimator.model.arrays import Record
from bms_estimator.model.input_faults import InputFault
from bms_estimator.numba_cache import njit

GATE_STDS = 6.0
"""Limit of the innovation gate in std: a sample beyond it is a glitch."""
GATE_SAMPLES, GATE_S = 5, 5.0
"""Number of successive samples beyond the gate, and their minimum duration [s], after which they are accepted because
the cell has changed."""
SNAPSHOT_S = 60.0
"""Interval at which the last good state is stored [s]."""
LOST_STD = 0.05
"""Std of the SOC after a return to the last good state."""
LOST_AT_MOST = 0.4
"""No SOC is less certain than this, std."""
SIGN_S = 300.0
"""Memory of the relation between voltage and current changes, counted while the current changes [s]."""
MIN_EVIDENCE = 0.1
"""Share of that memory which must be filled."""
CLIP = 5.0
"""Limit of a voltage change, in multiples of what the resistances explain, so that a glitch to zero does not
dominate."""
MANY_OUTLIERS, FEW_OUTLIERS = 5.0, 1.0
OFFSET_STDS, CAPACITY_STDS = 4.0, 2.0
"""Limits of offset and capacity, in multiples of their initial std, beyond which they are suspicious."""
PRESENT_STDS = 3.0
"""Minimum deviation of a suspicious offset or capacity in multiples of its present std."""
TAKEN_BACK = 0.7
"""A suspicion ends when its measure falls below this fraction of its limit."""
WRONG_V, WRONG_S = 0.12, 1800.0
"""Bias of one cell [V] and duration [s] that no OCV of the cell's own chemistry explains."""
SEARCHES_S = 5.0 * 3600.0
"""Memory of searches for the SOC: time after time only a wrong OCV explains them [s]."""
MANY_SEARCHES = 4.0
UNKNOWN_K = 5.0
"""Distance from the temperatures of the cell file beyond which the model has no data [K]."""

SIGN_OF_CURRENT, OFFSET_BIT, CAPACITY, OCV, OUTLIERS, TEMPERATURE, VOLTAGE, CURRENT = (int(bit) for bit in InputFault)
UNUSABLE = SIGN_OF_CURRENT | VOLTAGE | CURRENT
"""No voltage is believed meanwhile."""

CHECKS = np.dtype(
    [
        ("mean_a", "f8"),  # current at the last update of the filter [A]
        ("gated_in_row", "i8"),
        ("gated_s", "f8"),  # how long samples have been gated [s]
        ("outliers", "f8"),  # single samples not believed of late
        ("slow_v", "f8"),  # voltage and ...
        ("slow_a", "f8"),  # ... current without their fast changes
        ("slower_v", "f8"),  # the same of these two
        ("slower_a", "f8"),
        ("sign_evidence", "f8"),  # 0..1: how much was seen of
        ("change_v_a", "f8"),  # running mean of the fast change of voltage times that of current [V A]
        ("change_a2", "f8"),  # the same of the current's squared [A^2]
        ("last_v", "f8"),  # of the sample before; 0: none
        ("last_a", "f8"),
        ("step_v", "f8"),  # the smallest change of voltage seen [V]; 0: none yet
        ("frozen_v_s", "f8"),  # time for which the voltage has been impossibly constant [s]
        ("frozen_a_s", "f8"),  # time for which the current has been impossibly constant
        ("held_as", "f8"),  # charge since the voltage last changed [A s]; values at that time:
        ("held_a", "f8"),  # current [A],
        ("held_soc", "f8"),
        ("held_soc_std", "f8"),
        ("same_s", "f8"),  # time for which the current has been constant [s]; SOC and its std at its beginning
        ("same_soc", "f8"),
        ("same_soc_std", "f8"),
        ("wrong_v", "f8"),  # running mean of the error that stays [V]
        ("searches", "f8"),  # times the filter began again of late
        ("seen_reopened", "i8"),
        ("suspects", "i8"),  # bits of model.input_faults.InputFault
        ("good_mean", "f8", STATES),  # state of the likeliest filter when it was last saved
        ("good_covariance", "f8", (STATES, STATES)),
        ("good_soc", "f8"),
        ("good_soc_std", "f8"),
        ("good_age_s", "f8"),
    ],
    align=True,
)

COUNTERS = np.dtype(
    [
        ("gated", "i8"),  # samples not believed
        ("reopened", "i8"),  # number of successive ones
        ("reset", "i8"),  # not finite: back to the last good state
    ],
    align=True,
)


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
    """Return True if the filter may use a sample: its voltage is near the prediction, or stays beyond the gate.

    Args:
        c: Record of CHECKS.
        n: Record of COUNTERS.
        f: Record of EKF_STATE.
        p: Record of EKF_SETTINGS.
        e: Record of EQUIVALENT.
        dt_s: Time since the sample before [s].
        change_a: Change of the current since then [A].
        current_a: Current [A].
        voltage_v: Voltage [V].
    """
    away_a = current_a - c.mean_a
    predicted_v = f.voltage_v - e.value[R_S] * away_a
    jump_v = (e.value[R_S] + e.value[R_TS] + e.value[R_TL]) * max(abs(away_a), abs(change_a))
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
    """Return True if enough successive samples lie beyond the gate, which then are not glitches."""
    return c.gated_in_row >= GATE_SAMPLES and c.gated_s >= GATE_S


@njit(cache=True)
def store_last_good_state(c: Record, f: Record) -> None:
    """Save the likeliest filter as the last good state."""
    c.good_mean[:] = f.mean[f.best]
    c.good_covariance[:, :] = f.covariance[f.best]
    c.good_soc, c.good_soc_std, c.good_age_s = f.soc, f.soc_std, 0.0


@njit(cache=True)
def restore_if_not_finite(c: Record, n: Record, f: Record, p: Record, dt_s: float) -> None:
    """Back to the last good state when anything of the filter is not finite; otherwise save it at intervals."""
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
    f.mean[0, :] = c.good_mean
    f.covariance[0, :, :] = c.good_covariance
    if not math.isfinite(f.temperature_c):
        f.temperature_c, f.sensed = REFERENCE_C, 0  # the next input is accepted at once
        f.weak = f.strong = f.hysteresis = 1.0
    initialize_load_statistics(f, p, f.current_a)
    spawn_hypotheses(f, p, c.good_soc, math.sqrt(c.good_soc_std**2 + LOST_STD**2))
    reset_window(f)
    n.reset += 1


@njit(cache=True)
def track_current_sign(c: Record, p: Record, dt_s: float, current_a: float, voltage_v: float) -> None:
    """Track how fast changes of the voltage follow those of the current: by -R_s if the sign is right.

    A ramp is no change: where the curve ends, the voltage has one by itself.
    """
    if dt_s > FAST_S or c.slow_v == 0.0:  # too long to judge, or the first sample
        c.slow_v = c.slower_v = voltage_v
        c.slow_a = c.slower_a = current_a
        return
    ohm = p.middle_ohm
    change_a = current_a - 2.0 * c.slow_a + c.slower_a
    limit_v = CLIP * ohm * abs(change_a)
    change_v = min(max(voltage_v - 2.0 * c.slow_v + c.slower_v, -limit_v), limit_v)
    share = min(1.0, dt_s / FAST_S)
    c.slower_v += share * (c.slow_v - c.slower_v)
    c.slower_a += share * (c.slow_a - c.slower_a)
    c.slow_v += share * (voltage_v - c.slow_v)
    c.slow_a += share * (current_a - c.slow_a)
    visible = min(1.0, (ohm * change_a / (VISIBLE_V * p.series)) ** 2)
    weight = visible * min(1.0, dt_s / SIGN_S)
    c.sign_evidence += weight * (1.0 - c.sign_evidence)
    c.change_v_a += weight * (change_v * change_a - c.change_v_a)
    c.change_a2 += weight * (change_a * change_a - c.change_a2)


@njit(cache=True)
def unusable_input_bits(c: Record, p: Record) -> int:
    """Return the bits of faults that forbid the use of the voltage; 0: the voltage is usable."""
    if sign_is_wrong(c, p):
        return SIGN_OF_CURRENT
    return (VOLTAGE if c.frozen_v_s > FROZEN_S else 0) | (CURRENT if c.frozen_a_s > FROZEN_S else 0)


@njit(cache=True)
def sign_is_wrong(c: Record, p: Record) -> bool:
    """Return True if the voltage rises with a reported discharge; a present suspicion stays until it falls."""
    steep = 0.25 * reference_series_resistance(p) * c.change_a2
    return c.change_v_a > (0.0 if c.suspects & SIGN_OF_CURRENT else steep) and c.sign_evidence > MIN_EVIDENCE


@njit(cache=True)
def coast_without_voltage(c: Record, f: Record, p: Record, dt_s: float, current_a: float) -> None:
    """Process a sample without using its voltage, while voltage and current do not belong together.

    With the wrong sign of the current the SOC errs by twice the charge, always the same way; a current that is not measured may be
    anything common. Estimates learned with the wrong sign are useless, so the filter is re-initialized afterwards.
    """
    moved = abs(current_a) * min(dt_s, p.unmeasured_s) / p.capacity_as
    wrong = UNCOUNTED * moved
    if c.suspects & CURRENT:
        wrong = p.load_mean_c * min(dt_s, p.unmeasured_s) / 3600.0
    elif c.suspects & SIGN_OF_CURRENT:
        wrong = 2.0 * moved
    f.soc_std = min(math.hypot(f.soc_std + wrong, f.window.unknown_as / p.capacity_as), LOST_AT_MOST)
    f.window.unknown_as = 0.0
    f.step.phase = UNHELD
    bits = unusable_input_bits(c, p)
    if bits:
        c.suspects = bits
        return
    if c.suspects & SIGN_OF_CURRENT:
        soc_std = max(f.soc_std, p.soc_std)
        initialize_filter(f, p, f.soc, f.current_a, f.temperature_c if f.sensed else math.nan)
        spawn_hypotheses(f, p, f.soc, soc_std)
    else:
        spawn_hypotheses(f, p, f.soc, max(f.soc_std, LOST_STD))
    reset_window(f)
    c.suspects = 0


@njit(cache=True)
def update_input_faults(c: Record, f: Record, p: Record, dt_s: float) -> None:
    """Set and take back the bits of ``c.suspects`` after an update of the filter over ``dt_s``."""
    before = c.suspects
    c.outliers -= c.outliers * min(1.0, dt_s / OUTLIERS_S)
    bits = unusable_input_bits(c, p)
    if bits:
        if bits != SIGN_OF_CURRENT:
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
    c.wrong_v += min(1.0, dt_s / WRONG_S) * (x[B_SLOW] - c.wrong_v)
    c.searches += f.reopened - c.seen_reopened - min(1.0, dt_s / SEARCHES_S) * c.searches
    c.seen_reopened = f.reopened
    part = TAKEN_BACK if before & OCV else 1.0
    if abs(c.wrong_v) > part * WRONG_V * p.series or c.searches > part * MANY_SEARCHES:
        bits = OCV | bits & OUTLIERS  # offset and capacity try to explain it
    outside_k = max(p.low_c - f.temperature_c, f.temperature_c - p.high_c)
    if f.sensed and outside_k > UNKNOWN_K * (TAKEN_BACK if before & TEMPERATURE else 1.0):
        bits |= TEMPERATURE
    c.suspects = bits


@njit(cache=True)
def is_significant_bias(value: float, variance: float, expected: float, before: int) -> bool:
    """Return True if a bias exceeds its expected size significantly."""
    part = TAKEN_BACK if before else 1.0
    return expected > 0.0 and abs(value) > part * max(expected, PRESENT_STDS * math.sqrt(variance))
