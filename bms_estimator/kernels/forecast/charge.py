"""Time until the charger ends the present charge: constant current, then constant voltage down to the tail current.

At constant voltage the current decays about exponentially. Once it does, its measured time constant gives the time. Before that,
the charge is simulated with the filter's model. In a cell whose OCV has a plateau, the surface of the particles is fuller than
their mean during a charge, because the charge has to diffuse from the surface. The SOC at the surface determines the voltage.

``s`` is a record of EKF_STATE, ``p`` of EKF_SETTINGS. Currents are positive on discharge, so that the charge current is below 0.
"""

import math

from bms_estimator.kernels.cell_model.rc_ladder import BRANCHES, RESISTANCES, TAUS, TREND_PAIR
from bms_estimator.kernels.forecast.constant_current import (
    hypothesis_capacity,
    open_circuit_voltage,
    scaled_resistances,
)
from bms_estimator.kernels.kalman_filter.ocv_correction import NODE_CORRELATION
from bms_estimator.kernels.kalman_filter.records import SOC, X
from bms_estimator.model.arrays import Floats, Record
from bms_estimator.numba_cache import njit

MIN_CHARGE_C = 0.002
"""Minimum charge current, as a C-rate. A smaller one may be the offset of the sensor."""
SOC_STEP = 0.0025
"""SOC charged in a step. In the constant-voltage phase, the current changes by a few percent in a step."""
MAX_STEPS = 800
"""Maximum number of steps, in which twice the SOC range would be charged."""
CURRENT_PAIR = 2
"""Index of the RC pair (30 s) whose filtered current is the present charge current."""
LEAD_PAIR = 4
"""Index of the RC pair (500 s) whose filtered current is proportional to the lead: SOC at the surface of the particles minus
their mean."""
LEAD_S = 180.0
"""Lead as a charge, per ampere of the filtered current of ``LEAD_PAIR`` [A s / A], in cells whose OCV has a plateau. LFP cells
that are charged with C/2 to 3.65 V accept another 2 to 3 % at this voltage."""
FULL_TOLERANCE = 2e-3
"""Relative distance from the voltage of the constant-voltage phase within which this phase is detected."""
MAX_DECAY_RATIO = 0.97
"""Maximum ratio of the currents filtered with 30 s and with 120 s at which the current counts as decaying."""


@njit(cache=True)
def charge_current(s: Record, p: Record) -> float:
    """Return the present charge current [A], below 0; 0 unless the pack has been charged for some minutes.

    Short regeneration does not make the current filtered by RC pair ``TREND_PAIR`` (120 s) negative.
    """
    max_a = -MIN_CHARGE_C * p.capacity_as / 3600.0
    present_a = s.x_a[CURRENT_PAIR] + s.mean[s.best, X + CURRENT_PAIR]
    return present_a if max(present_a, s.x_a[TREND_PAIR] + s.mean[s.best, X + TREND_PAIR]) < max_a else 0.0


@njit(cache=True)
def time_to_full(s: Record, p: Record, charge_a: float, full_v: float, tail_a: float, scratch: Floats) -> float:
    """Return the time until the charger ends the charge [s], as a weighted mean over the hypotheses; NaN if it never ends.

    Args:
        s: Record of EKF_STATE.
        p: Record of EKF_SETTINGS.
        charge_a: Current of the constant-current phase [A], below 0.
        full_v: Voltage of the constant-voltage phase [V].
        tail_a: Charge current that ends this phase [A], above 0. A charge with a smaller current ends at ``full_v``.
        scratch: Scratch space of shape (RESISTANCES + BRANCHES,).
    """
    decay_s = constant_voltage_time(s, full_v, tail_a)
    if not math.isnan(decay_s):
        return decay_s
    total = time_s = 0.0
    for q in range(s.count):
        weight = math.exp(s.ln_weight[q] - s.ln_weight[s.best])
        total += weight
        time_s += weight * _hypothesis_time_to_full(s, p, q, charge_a, full_v, tail_a, scratch)
    return time_s / total


@njit(cache=True)
def constant_voltage_time(s: Record, full_v: float, tail_a: float) -> float:
    """Return the time until the constant-voltage phase ends [s]; NaN outside such a phase.

    For a current I e^(-t/tau), the current filtered with tau_k is I e^(-t/tau) / (1 - tau_k/tau). The ratio of two filtered
    currents gives tau.

    Args:
        s: Record of EKF_STATE.
        full_v: Voltage of the constant-voltage phase [V].
        tail_a: Charge current that ends this phase [A], above 0.
    """
    short_s, long_s = TAUS[CURRENT_PAIR], TAUS[TREND_PAIR]
    short_a = -s.x_a[CURRENT_PAIR] - s.mean[s.best, X + CURRENT_PAIR]
    long_a = -s.x_a[TREND_PAIR] - s.mean[s.best, X + TREND_PAIR]
    measured_v = s.voltage_v + s.innovation_v
    if measured_v < (1.0 - FULL_TOLERANCE) * full_v or not 0.0 < short_a < MAX_DECAY_RATIO * long_a or tail_a <= 0.0:
        return math.nan
    ratio = short_a / long_a
    tau_s = (long_s - short_s * ratio) / (1.0 - ratio)
    present_a = short_a * (1.0 - short_s / tau_s)
    return tau_s * math.log(max(present_a / tail_a, 1.0))


@njit(cache=True)
def _hypothesis_time_to_full(
    s: Record, p: Record, q: int, charge_a: float, full_v: float, tail_a: float, scratch: Floats
) -> float:
    """Return the time until the charger ends the charge from the state of hypothesis ``q`` [s]."""
    ohm, x = scratch[:RESISTANCES], scratch[RESISTANCES:]
    for k in range(BRANCHES):
        x[k] = s.x_a[k] + s.mean[q, X + k]
    soc, elapsed_s, capacity_as = s.mean[q, SOC], 0.0, hypothesis_capacity(s, p, q)
    current_a = voltage_limited_a = charge_a
    end_a = max(charge_a, -tail_a)
    for _ in range(MAX_STEPS):
        dt_s = -SOC_STEP * capacity_as / current_a
        before_a = voltage_limited_a
        voltage_limited_a = constant_voltage_current(s, p, q, soc, elapsed_s, current_a, dt_s, full_v, x, ohm)
        if voltage_limited_a >= end_a:  # the charge ends within this step
            return elapsed_s + dt_s * max(end_a - before_a, 0.0) / (voltage_limited_a - before_a)
        current_a = max(voltage_limited_a, charge_a)
        for k in range(BRANCHES):
            x[k] = current_a + (x[k] - current_a) * math.exp(-dt_s / TAUS[k])
        soc -= current_a * dt_s / capacity_as
        elapsed_s += dt_s
    return math.nan


@njit(cache=True)
def constant_voltage_current(
    s: Record,
    p: Record,
    q: int,
    soc: float,
    elapsed_s: float,
    guess_a: float,
    dt_s: float,
    voltage_v: float,
    x: Floats,
    ohm: Floats,
) -> float:
    """Return the constant current with which the terminal voltage is ``voltage_v`` after a step [A].

    The equation is linear in the current, because the OCV is linearized over the charge that ``guess_a`` moves.

    Args:
        s: Record of EKF_STATE.
        p: Record of EKF_SETTINGS.
        q: Index of the hypothesis.
        soc: SOC at the beginning of the step.
        elapsed_s: Time from now to the beginning of the step [s].
        guess_a: Approximate current [A], below 0.
        dt_s: Duration of the step [s].
        voltage_v: Terminal voltage at the end of the step [V].
        x: Filtered currents of the RC pairs at the beginning of the step [A], shape (BRANCHES,).
        ohm: Scratch space of shape (RESISTANCES,).
    """
    capacity_as = hypothesis_capacity(s, p, q)
    # without a plateau, and after a fit of the curve, the settings contain the correlation NODE_CORRELATION, and no lead applies
    lead_s = LEAD_S if p.node_correlation > NODE_CORRELATION else 0.0
    lead_decay = math.exp(-dt_s / TAUS[LEAD_PAIR])
    surface_soc = soc - lead_s * lead_decay * x[LEAD_PAIR] / capacity_as
    rise_soc = -guess_a * (dt_s + lead_s * (1.0 - lead_decay)) / capacity_as
    e_o_v = open_circuit_voltage(s, p, q, surface_soc, elapsed_s + dt_s)
    rise_v = open_circuit_voltage(s, p, q, surface_soc + rise_soc, elapsed_s + dt_s) - e_o_v
    scaled_resistances(s, p, q, soc - guess_a * dt_s / capacity_as, ohm)
    remaining_v, total_ohm = e_o_v - voltage_v, ohm[0] - rise_v / guess_a
    for k in range(BRANCHES):
        decay = math.exp(-dt_s / TAUS[k])
        remaining_v -= ohm[1 + k] * decay * x[k]
        total_ohm += ohm[1 + k] * (1.0 - decay)
    return remaining_v / total_ohm
