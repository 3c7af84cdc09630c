"""Noise of the filter: each term of R, Q and P(0).

``s`` is a record of EKF_STATE, ``p`` of EKF_SETTINGS.
"""

import math

from bms_estimator.kernels.cell_model.chen_mora import ocv
from bms_estimator.kernels.cell_model.rc_ladder import (
    BRANCHES,
    REFERENCE_C,
    RESISTANCES,
    STRONG_J,
    TAUS,
    WEAK_J,
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

FLOOR_C = 0.1
"""The load counts as at least so large [C]: an idle cell is not a perfect model [1/h]."""
INDEPENDENT_S = 30.0
"""Maximum weight of a pause before a sample [s]."""
UNSENSED_R_STD = 0.25
"""Std of ln of the resistances without a temperature sensor: 10 K in both directions."""
WARMED_R_STD = 0.015
"""Increase of that std for each kelvin of modeled self-heating [1/K]: half of the heating may be wrong."""
AGED_SOC = 400.0
"""Charge over which aging changes the curve of a cell: 200 full cycles [SOC]."""
HYST_LEFT = 0.17
"""Std of the hysteresis h if the direction of the charge is known."""
LOWER_HALF = 0.5
"""SOC below which a cell may be empty early."""
STEEP_V = 1.0
"""Slope of the OCV of a cell that is its last fall [V]; if it is smaller, ``curve_error_v`` is the error of the
curve."""
USUAL_LN_R = 0.25
"""Up to this ln of the resistances over those of the file, the error of the model does not grow with them."""
OUTSIDE_K = 30.0
"""Distance from the temperatures of the cell file at which the model's errors double [K]."""


@njit(cache=True)
def extrapolation_factor(p: Record, temperature_c: float) -> float:
    """Factor on errors of the model beyond the temperatures that the cell file was made for."""
    return 1.0 + max(p.low_c - temperature_c, temperature_c - p.high_c, 0.0) / OUTSIDE_K


@njit(cache=True)
def max_known_temperature(p: Record) -> float:
    """Above it resistances are smaller, but errors are not [C]."""
    return max(p.high_c, REFERENCE_C)


@njit(cache=True)
def resistance_std(s: Record, p: Record) -> float:
    """Std of ln of the true over the file's resistances: without a temperature they may be anything near."""
    if s.sensed:
        return p.r_std
    return max(p.r_std, math.hypot(UNSENSED_R_STD, WARMED_R_STD * (s.temperature_c - REFERENCE_C)))


@njit(cache=True)
def offset_variance(p: Record) -> float:
    """Return the initial variance of OFFSET [A^2]."""
    return (p.offset_c * p.capacity_as / 3600.0) ** 2


@njit(cache=True)
def measurement_variance(s: Record, p: Record, dt_s: float, samples: int) -> float:
    """R [V^2] of the mean voltage of a window: what the ladder leaves, far more than the sensor's noise."""
    measured_c = s.temperature_c if s.sensed else REFERENCE_C  # estimated values do not reduce errors
    model_v = (
        p.model_v
        * arrhenius(p.model_j, min(measured_c, max_known_temperature(p)))
        * extrapolation_factor(p, s.temperature_c)
    )
    return model_v * model_v / min(max(dt_s, 1.0), INDEPENDENT_S) + p.sensor_v2 / samples


@njit(cache=True)
def bias_variance(s: Record, p: Record, q: int) -> float:
    """Variance of B_SLOW + B_FAST [V^2] of hypothesis ``q`` at a steady state: resistances are wrong in proportion, and along SOC.

    Resistances that were found to be larger than those of the file leave a larger error.

    A cold cell is empty early, and no file predicts by how much: in its lower half the shift along SOC grows in the
    cold as the weak part does, and also moves the knee of the OCV near empty.
    """
    soc, scale = s.mean[q, SOC], math.exp(max(s.mean[q, LN_R] - USUAL_LN_R, 0.0))
    ohm = total_resistance(s, p, soc)
    shift, early_v = p.bias_soc, 0.0
    if soc < LOWER_HALF:
        shift *= s.weak
        early_v = 0.5 * (ocv(soc + shift, p.ocv_v, p.ocv_slope_v) - ocv(soc - shift, p.ocv_v, p.ocv_slope_v))
        early_v = max(early_v - STEEP_V * p.series * shift, 0.0)
    steep = total_resistance(s, p, soc - shift) - total_resistance(s, p, soc + shift)
    grown = max(ohm - p.middle_ohm, 0.0)
    floor_a = FLOOR_C * p.capacity_as / 3600.0
    wrong_ohm2 = (p.bias_relative * ohm) ** 2 + (p.bias_grown * grown) ** 2 + (0.5 * steep) ** 2
    wrong_v2 = scale * scale * wrong_ohm2 * max(s.rms_a2, floor_a * floor_a) + early_v * early_v
    return extrapolation_factor(p, s.temperature_c) ** 2 * wrong_v2


@njit(cache=True)
def total_resistance(s: Record, p: Record, soc: float) -> float:
    """Sum of the resistances at ``soc``, at least that within the file's temperatures [ohm]."""
    weak, strong, most_c = s.weak, s.strong, max_known_temperature(p)
    if s.temperature_c > most_c:
        weak, strong = arrhenius(WEAK_J, most_c), arrhenius(STRONG_J, most_c)
    resistances(soc, p.weak_ohm, p.strong_ohm, weak, strong, s.ohm)
    total = 0.0
    for k in range(RESISTANCES):
        total += s.ohm[k]
    return total


@njit(cache=True)
def add_process_noise(s: Record, p: Record, q: int, moved: float, bias_v2: float) -> None:
    """Q of one step into the covariance of hypothesis ``q``; the diagonal of F is in ``s.f``.

    Args:
        s: Record of EKF_STATE.
        p: Record of EKF_SETTINGS.
        q: Hypothesis.
        moved: Magnitude of the charge moved, per unit of SOC.
        bias_v2: ``bias_variance`` [V^2].
    """
    cov, f, w = s.covariance[q], s.f, s.window
    dt_s = w.time_s
    if w.unknown_as > 0.0:
        add_gap_noise(p, cov, f, w.unknown_as / dt_s, dt_s / p.capacity_as)
    cov[SOC, SOC] += p.charge_error**2 * moved
    if w.between_as2 + w.rounded_as2 > 0.0:
        cov[SOC, SOC] += (w.between_as2 + w.rounded_as2) / (p.capacity_as * p.capacity_as)
        for k in range(X, X + BRANCHES):
            cov[k, k] += w.between_as2 / (dt_s * dt_s) * (1.0 - f[k]) ** 2
    a2 = (p.x_relative * w.charge_as / dt_s) ** 2
    for k in range(X, X + BRANCHES):
        cov[k, k] += a2 * (1.0 - f[k] * f[k])
    cov[B_SLOW, B_SLOW] += 0.5 * bias_v2 * s.slow_inflation[q] * (1.0 - f[B_SLOW] ** 2)
    cov[B_FAST, B_FAST] += 0.5 * bias_v2 * s.fast_inflation[q] * (1.0 - f[B_FAST] ** 2)
    cov[OFFSET, OFFSET] += offset_variance(p) * (1.0 - f[OFFSET] ** 2)
    cov[LN_Q, LN_Q] += p.capacity_std**2 * (1.0 - f[LN_Q] ** 2)
    for j in (LN_R0, LN_R):
        cov[j, j] += resistance_std(s, p) ** 2 * (1.0 - f[j] * f[j])
    cov[HYST, HYST] += HYST_LEFT**2 * (1.0 - f[HYST] ** 2)
    cov[CURVE, CURVE] += 1.0 - f[CURVE] ** 2
    for j in range(NODE, NODE + NODES):
        cov[j, j] += max(1.0 - cov[j, j], 0.0) * moved / AGED_SOC


@njit(cache=True)
def add_gap_noise(p: Record, cov: Floats, f: Floats, std_a: float, soc_per_a: float) -> None:
    """Add the noise of an unmeasured current that stays constant, so that it moves SOC and branches together.

    Its change has the same size: the RC pairs, which respond to the last seconds or minutes, belong to another mean
    than the SOC. Otherwise the voltage after the gap would determine the SOC.

    Args:
        p: Record of EKF_SETTINGS.
        cov: Shape (STATES, STATES), updated.
        f: Diagonal of F over that time.
        std_a: Standard deviation of the current [A].
        soc_per_a: SOC drawn per ampere [1/A].
    """
    for j in range(SOC, X + BRANCHES):
        by_j = -soc_per_a if j == SOC else 1.0 - f[j]
        for k in range(SOC, j + 1):
            added = by_j * (-soc_per_a if k == SOC else 1.0 - f[k])
            if k >= X:
                since = math.sqrt((1.0 - f[j] * f[j]) * (1.0 - f[k] * f[k]))
                added += since * branch_covariance(p.load_s, TAUS[j - X], TAUS[k - X])
            cov[j, k] += std_a * std_a * added
            cov[k, j] = cov[j, k]


@njit(cache=True)
def branch_covariance(t: float, tau_k: float, tau_m: float) -> float:
    """Stationary covariance of branches of ``tau_k`` and ``tau_m`` [s] under a Gauss-Markov load of ``t`` [s], over its variance."""
    return (t / (t + tau_m) / tau_k + t / (t + tau_k) / tau_m) / (1.0 / tau_k + 1.0 / tau_m)


@njit(cache=True)
def initial_branch_currents(p: Record, current_a: float, mean: Floats, covariance: Floats) -> None:
    """Set mean and covariance of x_k for an unknown load before switch-on, given the current at switch-on.

    The load was a level, normal with mean ``load_mean_c`` and std ``load_level_c``, and on it a Gauss-Markov process of
    time constant t = ``load_s`` and std ``load_c``. Of that, the stationary covariance of branch k and the current is t/(t+tau_k).

    Args:
        p: Record of EKF_SETTINGS.
        current_a: At the first sample [A].
        mean: Shape (STATES,), its x_k are written.
        covariance: Shape (STATES, STATES), its x_k are written.
    """
    one_c = p.capacity_as / 3600.0
    level_a2, load_a2, t = (p.load_level_c * one_c) ** 2, (p.load_c * one_c) ** 2, p.load_s
    for k in range(BRANCHES):
        with_k = level_a2 + load_a2 * t / (t + TAUS[k])
        mean[X + k] = p.load_mean_c * one_c
        mean[X + k] += with_k / (level_a2 + load_a2) * (current_a - p.load_mean_c * one_c)
        for m in range(BRANCHES):
            with_m = level_a2 + load_a2 * t / (t + TAUS[m])
            both = level_a2 + load_a2 * branch_covariance(t, TAUS[k], TAUS[m])
            covariance[X + k, X + m] = both - with_k * with_m / (level_a2 + load_a2)
