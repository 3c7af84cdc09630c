"""Noise covariances of the filter: the terms of R, Q and P(0).

``s`` is a record of EKF_STATE, ``p`` of EKF_SETTINGS.
"""

import math

from bms_estimator.kernels.cell_model.chen_mora import ocv
from bms_estimator.kernels.cell_model.rc_ladder import (
    BRANCHES,
    HIGH_ACTIVATION_ENERGY,
    LOW_ACTIVATION_ENERGY,
    REFERENCE_C,
    RESISTANCES,
    TAUS,
    arrhenius,
    resistances,
)
from bms_estimator.kernels.kalman_filter.records import (
    B_FAST,
    B_SLOW,
    CURVE,
    HYST,
    LN_Q,
    LN_R,
    LN_R0,
    NODE,
    NODES,
    OFFSET,
    SOC,
    X,
)
from bms_estimator.model.arrays import Floats, Record
from bms_estimator.numba_cache import njit

MIN_LOAD_C = 0.1
"""Minimum load in the variance of the biases, as a C-rate. The model has errors in an idle cell, too."""
INDEPENDENT_S = 30.0
"""Time after which the errors of successive windows count as independent [s]. R decreases with the window's duration up to
this time."""
UNSENSED_R_STD = 0.25
"""Std of ln of the resistances without a temperature sensor. It is the effect of a deviation of 10 K."""
WARMED_R_STD = 0.015
"""Additional std of ln of the resistances for each kelvin of modelled self-heating [1/K]. It is the effect of an error of half
of the heating."""
AGED_SOC = 400.0
"""Charge throughput over which aging changes the OCV curve of a cell [SOC]: 200 full cycles."""
HYST_STEADY_STD = 0.17
"""Std of the hysteresis state h after a long charge or discharge."""
EARLY_EMPTY_SOC = 0.5
"""SOC below which the model includes the early end of discharge of a cold cell."""
KNEE_SLOPE_V = 1.0
"""Minimum slope of the OCV of one cell at its knee near empty [V]. On flatter parts ``curve_error_v`` covers the error of
the curve."""
BIAS_GROWTH_LN_R = 0.25
"""LN_R above which the variance of the biases grows with the resistances."""
OUTSIDE_K = 30.0
"""Distance from the temperature range of the cell file at which the model's errors double [K]."""


@njit(cache=True)
def extrapolation_factor(p: Record, temperature_c: float) -> float:
    """Return the factor on errors of the model outside the temperature range of the cell file."""
    return 1.0 + max(p.low_c - temperature_c, temperature_c - p.high_c, 0.0) / OUTSIDE_K


@njit(cache=True)
def max_known_temperature(p: Record) -> float:
    """Return the temperature above which errors of the model do not decrease with the resistances [C]."""
    return max(p.high_c, REFERENCE_C)


@njit(cache=True)
def resistance_std(s: Record, p: Record) -> float:
    """Return the std of ln of the true over the file's resistances, larger without a temperature sensor."""
    if s.sensed:
        return p.r_std
    return max(p.r_std, math.sqrt(UNSENSED_R_STD**2 + (WARMED_R_STD * (s.temperature_c - REFERENCE_C)) ** 2))


@njit(cache=True)
def offset_variance(p: Record) -> float:
    """Return the initial variance of OFFSET [A^2]."""
    return (p.offset_c * p.capacity_as / 3600.0) ** 2


@njit(cache=True)
def measurement_variance(s: Record, p: Record, dt_s: float, samples: int) -> float:
    """Return R of the mean voltage of a window [V^2], mainly the error of the ladder and only little sensor noise."""
    measured_c = s.temperature_c if s.sensed else REFERENCE_C  # a modelled temperature does not reduce errors
    model_v = (
        p.model_v
        * arrhenius(p.model_j, min(measured_c, max_known_temperature(p)))
        * extrapolation_factor(p, s.temperature_c)
    )
    return model_v * model_v / min(max(dt_s, 1.0), INDEPENDENT_S) + p.sensor_v2 / samples


@njit(cache=True)
def skew_variance(s: Record, p: Record) -> float:
    """Return the variance of the window's mean voltage due to interpolated currents through R_0 [V^2].

    The covariance of the RC pairs contains their part.
    """
    x, w = s.mean[s.best], s.window
    if w.skew_a2 == 0.0:
        return 0.0
    resistances(x[SOC], p.weak_ohm, p.strong_ohm, s.weak, s.strong, s.ohm)
    r_0_ohm = math.exp(x[LN_R0]) * s.ohm[0]
    return r_0_ohm * r_0_ohm * w.skew_a2 / (w.samples * w.samples)


@njit(cache=True)
def bias_variance(s: Record, p: Record, q: int) -> float:
    """Return the steady-state variance of B_SLOW + B_FAST of hypothesis ``q`` under the load of the last ten minutes [V^2]."""
    return load_bias_variance(s, p, q, s.rms_a2)


@njit(cache=True)
def load_bias_variance(s: Record, p: Record, q: int, load_a2: float) -> float:
    """Return the variance of the model's error of hypothesis ``q`` under a load with the mean square ``load_a2`` [V^2].

    The file's resistances have a relative error and a shift along SOC. The error grows with LN_R above ``BIAS_GROWTH_LN_R``.

    A cold cell is empty early by an amount that no file predicts. Below ``EARLY_EMPTY_SOC`` the shift along SOC therefore
    grows in the cold with the Arrhenius factor of the weak part, and it also shifts the knee of the OCV near empty.
    """
    soc, scale = s.mean[q, SOC], math.exp(max(s.mean[q, LN_R] - BIAS_GROWTH_LN_R, 0.0))
    ohm = total_resistance(s, p, soc)
    shift, early_v = p.bias_soc, 0.0
    if soc < EARLY_EMPTY_SOC:
        shift *= s.weak
        early_v = 0.5 * (ocv(soc + shift, p.ocv_v, p.ocv_slope_v) - ocv(soc - shift, p.ocv_v, p.ocv_slope_v))
        early_v = max(early_v - KNEE_SLOPE_V * p.series * shift, 0.0)
    shift_ohm = total_resistance(s, p, soc - shift) - total_resistance(s, p, soc + shift)
    grown_ohm = max(ohm - p.middle_ohm, 0.0)
    min_load_a = MIN_LOAD_C * p.capacity_as / 3600.0
    error_ohm2 = (p.bias_relative * ohm) ** 2 + (p.bias_grown * grown_ohm) ** 2 + (0.5 * shift_ohm) ** 2
    error_v2 = scale * scale * error_ohm2 * max(load_a2, min_load_a * min_load_a) + early_v * early_v
    return extrapolation_factor(p, s.temperature_c) ** 2 * error_v2


@njit(cache=True)
def total_resistance(s: Record, p: Record, soc: float) -> float:
    """Return the sum of the resistances at ``soc`` [ohm]. The temperature is limited to ``max_known_temperature``."""
    weak, strong, limit_c = s.weak, s.strong, max_known_temperature(p)
    if s.temperature_c > limit_c:
        weak, strong = arrhenius(LOW_ACTIVATION_ENERGY, limit_c), arrhenius(HIGH_ACTIVATION_ENERGY, limit_c)
    resistances(soc, p.weak_ohm, p.strong_ohm, weak, strong, s.ohm)
    total = 0.0
    for k in range(RESISTANCES):
        total += s.ohm[k]
    return total


@njit(cache=True)
def add_process_noise(s: Record, p: Record, q: int, throughput: float, bias_v2: float) -> None:
    """Add Q of one step to the covariance of hypothesis ``q``; the diagonal of F is in ``s.f``.

    Args:
        s: Record of EKF_STATE.
        p: Record of EKF_SETTINGS.
        q: Index of the hypothesis.
        throughput: Charge throughput [SOC].
        bias_v2: ``bias_variance`` [V^2].
    """
    cov, f, w = s.covariance[q], s.f, s.window
    dt_s = w.time_s
    if w.unknown_as > 0.0:
        add_gap_noise(p, cov, f, w.unknown_as / dt_s, dt_s / p.capacity_as)
    cov[SOC, SOC] += p.charge_error**2 * throughput
    if w.between_as2 + w.rounded_as2 > 0.0:
        cov[SOC, SOC] += (w.between_as2 + w.rounded_as2) / (p.capacity_as * p.capacity_as)
        for k in range(X, X + BRANCHES):
            cov[k, k] += w.between_as2 / (dt_s * dt_s) * (1.0 - f[k]) ** 2
    error_a2 = (p.x_relative * w.charge_as / dt_s) ** 2
    for k in range(X, X + BRANCHES):
        cov[k, k] += error_a2 * (1.0 - f[k] * f[k])
    # both biases have half of the variance
    cov[B_SLOW, B_SLOW] += 0.5 * bias_v2 * s.slow_inflation[q] * (1.0 - f[B_SLOW] ** 2)
    cov[B_FAST, B_FAST] += 0.5 * bias_v2 * s.fast_inflation[q] * (1.0 - f[B_FAST] ** 2)
    cov[OFFSET, OFFSET] += offset_variance(p) * (1.0 - f[OFFSET] ** 2)
    cov[LN_Q, LN_Q] += p.capacity_std**2 * (1.0 - f[LN_Q] ** 2)
    for j in (LN_R0, LN_R):
        cov[j, j] += resistance_std(s, p) ** 2 * (1.0 - f[j] * f[j])
    cov[HYST, HYST] += HYST_STEADY_STD**2 * (1.0 - f[HYST] ** 2)
    cov[CURVE, CURVE] += 1.0 - f[CURVE] ** 2
    for j in range(NODE, NODE + NODES):
        cov[j, j] += max(1.0 - cov[j, j], 0.0) * throughput / AGED_SOC


@njit(cache=True)
def add_gap_noise(p: Record, cov: Floats, f: Floats, std_a: float, soc_per_a: float) -> None:
    """Add the noise of an unmeasured current with a constant and a varying part.

    The constant part moves SOC and RC pairs with full correlation. The varying part has an equal std and moves only the RC
    pairs, which respond to the last seconds or minutes. Without that part, the voltage after the gap would determine the
    SOC.

    Args:
        p: Record of EKF_SETTINGS.
        cov: Shape (STATES, STATES), updated.
        f: Diagonal of F over the gap.
        std_a: Standard deviation of the current [A].
        soc_per_a: SOC drawn per ampere [1/A].
    """
    for j in range(SOC, X + BRANCHES):
        by_j = -soc_per_a if j == SOC else 1.0 - f[j]
        for k in range(SOC, j + 1):
            added = by_j * (-soc_per_a if k == SOC else 1.0 - f[k])
            if k >= X:
                renewed = math.sqrt((1.0 - f[j] * f[j]) * (1.0 - f[k] * f[k]))
                added += renewed * branch_covariance(p.load_s, TAUS[j - X], TAUS[k - X])
            cov[j, k] += std_a * std_a * added
            cov[k, j] = cov[j, k]


@njit(cache=True)
def branch_covariance(t: float, tau_k: float, tau_m: float) -> float:
    """Return the stationary covariance of two RC pairs' filtered currents, relative to the variance of the load.

    Args:
        t: Correlation time of the Gauss-Markov load [s].
        tau_k: Time constant of the first RC pair [s].
        tau_m: Time constant of the second RC pair [s].
    """
    return (t / (t + tau_m) / tau_k + t / (t + tau_k) / tau_m) / (1.0 / tau_k + 1.0 / tau_m)


@njit(cache=True)
def initial_branch_currents(p: Record, current_a: float, mean: Floats, covariance: Floats) -> None:
    """Set mean and covariance of x_k for an unknown load before switch-on, given the current at switch-on.

    The prior of the load is the sum of a constant level, normal with mean ``load_mean_c`` and std ``load_level_c``, and a
    Gauss-Markov process with time constant t = ``load_s`` and std ``load_c``. The stationary covariance of RC pair k and
    the current, relative to the variance of the process, is t / (t + tau_k).

    Args:
        p: Record of EKF_SETTINGS.
        current_a: Current at the first sample [A].
        mean: Shape (STATES,); x_k are written.
        covariance: Shape (STATES, STATES); rows and columns of x_k are written.
    """
    one_c = p.capacity_as / 3600.0
    level_a2, load_a2, t = (p.load_level_c * one_c) ** 2, (p.load_c * one_c) ** 2, p.load_s
    for k in range(BRANCHES):
        covariance_k = level_a2 + load_a2 * t / (t + TAUS[k])
        mean[X + k] = p.load_mean_c * one_c
        mean[X + k] += covariance_k / (level_a2 + load_a2) * (current_a - p.load_mean_c * one_c)
        for m in range(BRANCHES):
            covariance_m = level_a2 + load_a2 * t / (t + TAUS[m])
            joint = level_a2 + load_a2 * branch_covariance(t, TAUS[k], TAUS[m])
            covariance[X + k, X + m] = joint - covariance_k * covariance_m / (level_a2 + load_a2)
