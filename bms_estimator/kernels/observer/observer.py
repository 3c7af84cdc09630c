"""High-gain adaptive observer, Algorithm 1 of the thesis, and its gain, a Nussbaum function of section 2.2.2.

Numbers in parentheses are equations of the thesis, and errata are listed in docs/theory/thesis.md. The states x2 and x3 of
the thesis are ``v_ts`` and ``v_tl``.

y, i, N and a_i are constant over a sample period. Then (3.2)-(3.3) with u = -N e is linear with a symmetric 2x2 matrix and
is solved exactly. e is assumed to decay with the eigenvalue of the mode [1, 1], as for equal time constants. (3.18) is a
first-order lag, driven by the mean of e^2 over the period, and is solved exactly. Therefore the step is stable for every
N >= 0 and every period. ``s`` is a record of OBSERVER_STATE, ``p`` of OBSERVER_SETTINGS.
"""

import math
from enum import IntEnum

from bms_estimator.kernels.cell_model.chen_mora import PARAMETERS, c_tl, c_ts, delta, ocv, r_s, r_tl, r_ts, soc_from_ocv
from bms_estimator.kernels.cell_model.current_interpolation import interpolated_current
from bms_estimator.kernels.observer.mittag_leffler import mittag_leffler
from bms_estimator.model.arrays import Record
from bms_estimator.model.unmeasured_time import MAX_FLOW_S
from bms_estimator.numba_cache import njit


class Nussbaum(IntEnum):
    """Nussbaum function N(k), the gain of the observer."""

    MITTAG_LEFFLER = 0  # E_a(-lambda k^a), (3.10) with the sign of erratum 1 in docs/theory/thesis.md
    K2_COS = 1  # N1 = k^2 cos k
    K_COS_SQRT = 2  # N2 = k cos sqrt|k|
    LN_COS_SQRT_LN = 3  # N3 = ln k cos sqrt(ln k), k > 1


# constants of the compiled function, plain integers as the record's field ``nussbaum``
_K2_COS = int(Nussbaum.K2_COS)
_K_COS_SQRT = int(Nussbaum.K_COS_SQRT)
_LN_COS_SQRT_LN = int(Nussbaum.LN_COS_SQRT_LN)
MIN_LOOP_GAIN = 0.1
"""Lower limit of 1 + N R_s in the algebraic loop of (3.14). Near 0, a negative N reverses the sign of the loop."""
LOST = -1
"""Result of ``lock_transition``: the lock is lost."""
REGAINED = 1
"""Result of ``lock_transition``: the lock is regained."""


@njit(cache=True)
def nussbaum_gain(k: float, p: Record) -> float:
    """Return N(k), clamped to +-``gain_limit``.

    Args:
        k: Adaptive gain state (3.13) [V^2 s].
        p: Record of dtype ``OBSERVER_SETTINGS``.
    """
    if p.nussbaum == _K2_COS:
        gain = k * k * math.cos(k)
    elif p.nussbaum == _K_COS_SQRT:
        gain = k * math.cos(math.sqrt(abs(k)))
    elif p.nussbaum == _LN_COS_SQRT_LN:
        log_k = math.log(max(k, 1.0))
        gain = log_k * math.cos(math.sqrt(log_k))
    else:  # lambda k^a = (gain_scale k)^a, because gain_scale is lambda^(1/a)
        gain = mittag_leffler(p.gain_scale * k, p.alpha, p.ml_series, p.ml_decay, p.ml_decay_slope)
    return min(max(gain, -p.gain_limit), p.gain_limit)


@njit(cache=True)
def initialize(s: Record, p: Record, time_s: float, current_a: float, voltage_v: float) -> None:
    """Set the initial conditions of Algorithm 1 at the first sample."""
    s.time_s = time_s
    s.current_a = current_a
    for i in range(1, PARAMETERS):
        s.a[i] = p.a_initial[i]
        s.target[i] = p.target[i]
    s.k = p.k0
    s.gain = nussbaum_gain(s.k, p)
    s.lock = 1
    s.adapting = 1
    s.started = 1
    if p.capacity_as == 0.0:  # a fuel cell has neither SOC nor stability margins
        s.soc = s.soc_coulomb = s.delta_1 = s.delta_2 = math.nan
        return
    s.soc = p.soc_initial
    if math.isnan(s.soc):
        ohmic_v = current_a * r_s(1.0, s.a)  # R_s at full charge, because the SOC is not known yet
        s.soc = soc_from_ocv(voltage_v + ohmic_v, p.ocv_v, p.ocv_slope_v)
    s.soc_coulomb = s.soc
    s.voltage_estimate_v = ocv(s.soc, p.ocv_v, p.ocv_slope_v)  # (4.1), x2 = x3 = 0
    s.innovation_v = voltage_v - s.voltage_estimate_v
    update_margins(s)


@njit(cache=True)
def count_charge(s: Record, p: Record, dt_s: float, current_a: float) -> None:
    """Update SOC by coulomb counting (3.1). A fuel cell has no SOC."""
    if p.capacity_as > 0.0:
        charge_as = interpolated_current(dt_s, s.current_a, current_a, p.unmeasured_s) * min(dt_s, MAX_FLOW_S)
        s.soc_coulomb = min(max(s.soc_coulomb - charge_as / p.capacity_as, 0.0), 1.0)
    s.current_a = current_a


@njit(cache=True)
def observer_step(s: Record, p: Record, dt_s: float, voltage_v: float) -> None:
    """Advance the observer by one sample at the present SOC: Algorithm 1, lines 2 to 7."""
    e_o = ocv(s.soc, p.ocv_v, p.ocv_slope_v)

    # ``output_r_s`` is 1 for the output (3.14), which contains R_s, and 0 for the output (4.1)
    s.adapting = 1 if s.soc > stability_floor(s, p) else 0
    soc = max(s.soc, stability_floor(s, p))
    ohm_s = p.output_r_s * r_s(soc, s.a) if p.output_r_s > 0.0 else 0.0
    loop_gain = max(1.0 + s.gain * ohm_s, MIN_LOOP_GAIN)  # y^ contains R_s u, and u = -N e
    e = (voltage_v - e_o + s.v_ts + s.v_tl) / loop_gain  # (3.15) with (3.14) or (4.1)
    s.innovation_v = e

    tau_ts, tau_tl = r_ts(soc, s.a) * c_ts(soc, s.a), r_tl(soc, s.a) * c_tl(soc, s.a)
    rate_e = states_step(s, s.gain / loop_gain, voltage_v - e_o, tau_ts, tau_tl, dt_s)
    mean_square = integral_of_exponential(2.0 * rate_e * dt_s, 1.0)  # mean of e^2 over the sample / e^2 at its start

    if s.adapting:
        adapt_parameters(s, p, dt_s, e * e * mean_square)
        update_margins(s)

    excess = max(abs(e) - p.dead_zone_v, 0.0)
    if excess > 0.0:
        s.k += excess * excess * mean_square * dt_s  # (3.13) with the dead zone of erratum 2
        s.gain = nussbaum_gain(s.k, p)
    s.voltage_estimate_v = e_o - s.v_ts - s.v_tl  # (4.1)
    if p.output_r_s > 0.0:
        s.voltage_estimate_v = voltage_v - (voltage_v - s.voltage_estimate_v) / loop_gain  # (3.14), u = -N e
    track_lock(s, p, dt_s, voltage_v, e_o)


@njit(cache=True)
def adapt_parameters(s: Record, p: Record, dt_s: float, e_squared: float) -> None:
    """Apply the adaptive law (3.16), (3.17) or (3.18), a' = drive e^2 + rate (target - a), exactly for a constant e^2."""
    if dt_s != s.decay_dt_s:
        s.decay_dt_s = dt_s
        for i in range(1, PARAMETERS):
            s.decay[i] = math.exp(-p.rate[i] * dt_s)
            s.settle[i] = integral_of_exponential(-p.rate[i], dt_s)
    for i in range(1, PARAMETERS):
        s.a[i] = s.target[i] + (s.a[i] - s.target[i]) * s.decay[i] + p.drive[i] * e_squared * s.settle[i]


@njit(cache=True)
def update_margins(s: Record) -> None:
    """Compute delta1 (2.11) and delta2 (2.12), the SOCs below which C_ts and C_tl are negative, from the parameters."""
    s.delta_1 = delta(s.a[8], s.a[9], s.a[7])
    s.delta_2 = delta(s.a[11], s.a[12], s.a[10])


@njit(cache=True)
def stability_floor(s: Record, p: Record) -> float:
    """Return the minimum SOC for the circuit elements. Below it, a capacitance may be negative (erratum 14)."""
    return max(s.delta_1, s.delta_2) + p.margin_guard


@njit(cache=True)
def states_step(s: Record, gain: float, drop_v: float, tau_ts: float, tau_tl: float, dt_s: float) -> float:
    """Advance x2 and x3 by ``dt_s``, exactly: (3.2)-(3.3) with u = -gain (drop_v + x2 + x3) and constant gain and inputs.

    The matrix A is [[-1/tau_ts - gain, -gain], [-gain, -1/tau_tl - gain]]. Its exponential is ``along`` I + ``across``
    (A - ``mean`` I), and the integral of that exponential over the period is the same sum with ``phi_along`` and
    ``phi_across``.

    Returns:
        Eigenvalue of the mode [1, 1], with which the output error e decays if both time constants are equal [1/s].
    """
    mean = -gain - 0.5 * (1.0 / tau_ts + 1.0 / tau_tl)
    half = 0.5 * (1.0 / tau_tl - 1.0 / tau_ts)
    q = max(math.sqrt(half * half + gain * gain), 1e-300)  # not 0, because it is a divisor
    low, high = mean - q, mean + q
    phi_low = integral_of_exponential(low, dt_s)
    phi_high = integral_of_exponential(high, dt_s)
    decay_low = 1.0 + low * phi_low
    decay_high = 1.0 + high * phi_high
    along, across = 0.5 * (decay_high + decay_low), 0.5 * (decay_high - decay_low) / q
    phi_along, phi_across = 0.5 * (phi_high + phi_low), 0.5 * (phi_high - phi_low) / q
    u = -gain * drop_v
    v_ts, v_tl = s.v_ts, s.v_tl
    s.v_ts = along * v_ts + across * (half * v_ts - gain * v_tl) + u * (phi_along + phi_across * (half - gain))
    s.v_tl = along * v_tl + across * (-half * v_tl - gain * v_ts) + u * (phi_along + phi_across * (-half - gain))
    return low if gain >= 0.0 else high


@njit(cache=True)
def integral_of_exponential(rate: float, dt_s: float) -> float:
    """Return the integral of e^(rate t) over 0..dt_s [s]."""
    x = rate * dt_s
    if abs(x) < 1e-8:  # expm1(x) / rate would be 0 / 0 at rate 0
        return dt_s * (1.0 + 0.5 * x)
    return math.expm1(x) / rate


@njit(cache=True)
def track_lock(s: Record, p: Record, dt_s: float, voltage_v: float, e_o: float) -> None:
    """Detect a loss of lock (erratum 2) and recover from it.

    The lock is lost if the error exceeds ``lock_error_v`` for ``lock_time_s``, exceeds it with a gain of the wrong sign,
    or if the gain overflows. It is regained after the error has been within ``lock_error_v`` for ``lock_time_s``.
    While the observer is in lock, k is reset to k0 as soon as the gain falls below ``rearm_gain``, so that the gain does not
    become negative. Without a gain above ``rearm_gain`` at k0 there is no reset. The Nussbaum functions N1 to N3 start at or
    near 0 and may not have such a gain.
    """
    beyond = not abs(s.innovation_v) <= p.lock_error_v  # NaN counts as beyond
    wrong_sign = beyond and s.gain <= 0.0
    overflow = not (math.isfinite(s.v_ts) and math.isfinite(s.v_tl) and abs(s.gain) < p.gain_limit)
    change = lock_transition(s, p, dt_s, wrong_sign or overflow)
    if change == LOST:
        reinitialize_from_measurement(s, p, voltage_v, e_o)
    elif change == 0 and s.gain < p.rearm_gain and not beyond and nussbaum_gain(p.k0, p) > p.rearm_gain:
        s.k = p.k0
        s.gain = nussbaum_gain(s.k, p)
        s.gain_rearms += 1


@njit(cache=True)
def lock_transition(s: Record, p: Record, dt_s: float, at_once: bool) -> int:
    """Update the lock by the present error.

    Args:
        s: Record of OBSERVER_STATE.
        p: Record of OBSERVER_SETTINGS.
        dt_s: Time since the previous sample [s].
        at_once: True for a loss of lock without delay.

    Returns:
        ``LOST`` after the error exceeded ``lock_error_v`` for ``lock_time_s``, or at once; ``REGAINED`` after the error
        was within that limit for ``lock_time_s``; otherwise 0.
    """
    beyond = not abs(s.innovation_v) <= p.lock_error_v  # NaN counts as beyond
    if beyond == (s.lock == 1):
        # ``unlocked_s`` is the time for which the error has contradicted ``lock``. A sample adds at most a fifth of
        # ``lock_time_s``, so that a single sample after a long gap does not decide
        s.unlocked_s += min(dt_s, 0.2 * p.lock_time_s)
    else:
        s.unlocked_s = 0.0
    expired = s.unlocked_s >= p.lock_time_s
    if not (at_once or expired):
        return 0
    s.unlocked_s = 0.0
    if at_once or s.lock == 1:
        s.lock = 0
        s.lock_losses += 1
        return LOST
    s.lock = 1
    return REGAINED


@njit(cache=True)
def reinitialize_from_measurement(s: Record, p: Record, voltage_v: float, e_o: float) -> None:
    """Reinitialize the observer with e = 0, k = k0 and the parameters at their steady-state values ``target``."""
    s.k = p.k0
    s.gain = nussbaum_gain(s.k, p)
    s.v_ts = 0.5 * (e_o - voltage_v)
    s.v_tl = s.v_ts
    for i in range(1, PARAMETERS):
        s.a[i] = s.target[i]
    s.voltage_estimate_v = voltage_v
    update_margins(s)
