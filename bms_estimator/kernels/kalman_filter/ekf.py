"""Extended Kalman filter of one hypothesis: predict with F and Q, update with H, R and S.

``s`` is a record of EKF_STATE, ``p`` of EKF_SETTINGS, ``q`` the index of a hypothesis. Kernels neither allocate memory nor
read a clock.
"""

import math

from bms_estimator.kernels.cell_model.chen_mora import ocv
from bms_estimator.kernels.cell_model.rc_ladder import BRANCHES, REFERENCE_C, TAUS, TREND_PAIR, on_grid, resistances
from bms_estimator.kernels.kalman_filter.noise import add_process_noise, bias_variance, resistance_std
from bms_estimator.kernels.kalman_filter.ocv_correction import node_error_scale, node_position, ocv_correction
from bms_estimator.kernels.kalman_filter.records import (
    B_FAST,
    B_SLOW,
    CURVE,
    HYST,
    LN_Q,
    LN_R,
    LN_R0,
    NODE,
    OFFSET,
    SOC,
    STATES,
    X,
)
from bms_estimator.model.arrays import Floats, Record
from bms_estimator.numba_cache import njit

MIN_REACH = 0.02
"""Minimum half width of the secant that gives the OCV's slope [SOC]. Between its limits the half width is one std of the SOC."""
MAX_REACH = 0.3
"""Maximum half width of the secant that gives the OCV's slope [SOC]."""
MIN_SLOPE_V = 0.02
"""Minimum slope of the OCV of one cell [V per unit SOC]. With a smaller slope the filter diverges on a plateau."""
HUBER = 2.0
"""Maximum innovation in multiples of the square root of S (Huber). S is increased for a larger innovation."""
MINUTE_S = 60.0
"""Averaging time of the mean innovation that shows a persistent error within minutes [s]."""
TEN_MINUTES_S = 600.0
"""Averaging time of the mean innovation that shows a persistent error within tens of minutes [s]."""
INFLATION_AVERAGING = 5.0, 3.0
"""Averaging time of ``fast_inflation`` in multiples of ``MINUTE_S``, and of ``slow_inflation`` in multiples of
``TEN_MINUTES_S``."""
CONVERGED_SOC = 0.01
"""Change of the SOC below which the relinearization about the posterior has converged."""
MAX_ITERATIONS = 8
"""Maximum number of iterations of the relinearization about the posterior."""
MIN_SOC = -0.05
"""Lower limit of a filter's SOC."""
MAX_SOC = 1.05
"""Upper limit of a filter's SOC."""
MAX_STDS = 3.0
"""Maximum magnitude of LN_R0 and LN_R, in multiples of their initial std."""
MIN_LN_Q = math.log(0.5)
"""Lower limit of ln of the learned over the declared capacity. Aging reduces the capacity by up to half."""
MAX_LN_Q = math.log(1.3)
"""Upper limit of ln of the learned over the declared capacity. New cells exceed their declared capacity only
slightly."""
HOLD_CAPACITY, HOLD_NODES, HOLD_OFFSET, HOLD_CURVE = 1, 2, 4, 8
"""Bits of a set of states that an update does not change: LN_Q, the OCV nodes, OFFSET, and CURVE."""
HOLD_CELL = HOLD_CAPACITY | HOLD_NODES
"""States of the cell that do not change within hours."""
INDEPENDENT_R_STD = 0.5
"""Maximum std of the independent parts of LN_R0 and LN_R. The rest of a larger std is common to both, because it is due to
the unknown size of the cell. Only cell files of cells that were not measured have a larger std."""
NEARLY_FULL_C = 0.02
"""Maximum current above ``NEARLY_FULL_SOC`` at which LN_Q is updated although the resistances are uncertain, as a
C-rate. Larger overpotentials cannot be distinguished from a change of capacity."""
LEARNING_C = 0.4
"""Maximum current below ``NEARLY_FULL_SOC`` at which LN_Q is updated although the resistances are uncertain, as a
C-rate."""
NEARLY_FULL_SOC = 0.9
"""SOC above which ``NEARLY_FULL_C`` limits the current instead of ``LEARNING_C``."""
CHARGE_PAIR = TREND_PAIR + 1
"""Index of the RC pair of 500 s, whose filtered current distinguishes a charge from regeneration."""
CHARGE_C = 0.04
"""Minimum filtered current of a charge, as a C-rate. Regeneration is shorter and has a smaller one."""
VARYING_C = 0.2
"""Minimum standard deviation over 10 min of a load that distinguishes resistance from capacity, as a C-rate."""


@njit(cache=True)
def transition_diagonal(s: Record, p: Record) -> None:
    """Write the diagonal of F over the window to ``s.f``, except CURVE, which depends on the hypothesis."""
    f, dt_s, throughput_soc = s.f, s.window.time_s, s.window.throughput_as / p.capacity_as
    for j in range(STATES):
        f[j] = 1.0
    for k in range(BRANCHES):
        f[X + k] = math.exp(-dt_s / TAUS[k])
    f[B_SLOW], f[B_FAST] = math.exp(-dt_s / p.slow_s), math.exp(-dt_s / p.fast_s)
    f[HYST] = math.exp(-abs(hysteresis_charge(s, p)) / p.capacity_as / p.hysteresis_soc)
    f[OFFSET], f[LN_Q] = math.exp(-dt_s / p.offset_s), math.exp(-throughput_soc / p.aged_soc)
    if not s.sensed:
        f[LN_R0] = f[LN_R] = math.exp(-dt_s / p.unsensed_s)


@njit(cache=True)
def hysteresis_charge(s: Record, p: Record) -> float:
    """Return the charge that moves the hysteresis in the window [A s].

    It is computed with the trend of the current, because short regeneration does not reverse the hysteresis.
    """
    w = s.window
    return w.charge_as if w.gap and w.time_s > p.unmeasured_s else s.x_a[TREND_PAIR] * w.time_s


@njit(cache=True)
def predict(s: Record, p: Record, q: int) -> None:
    """Propagate mean and covariance over the window: x = f(x), P = F P F' + Q.

    F is diagonal, except that SOC depends on offset and capacity, and that the RC pairs depend on the offset.
    """
    x, cov, f, w = s.mean[q], s.covariance[q], s.f, s.window
    bias_v2 = bias_variance(s, p, q)
    capacity_as = p.capacity_as * math.exp(x[LN_Q])
    drawn_soc = (w.charge_as - x[OFFSET] * w.time_s) / capacity_as
    f[CURVE] = math.exp(-w.throughput_as / p.capacity_as / on_grid(x[SOC], p.curve_soc))
    for j in range(NODE):  # F is 1 for the nodes
        x[j] *= f[j]
    for j in range(STATES):
        factor, row = f[j], cov[j]
        for k in range(STATES if j < NODE else NODE):
            row[k] *= factor * f[k]
    x[SOC] -= drawn_soc  # (2.1) of the thesis
    x[HYST] -= math.copysign(1.0 - f[HYST], hysteresis_charge(s, p))
    for k in range(X, X + BRANCHES):
        x[k] -= (1.0 - f[k]) * x[OFFSET]
    apply_offdiagonal_transition(cov, f, w.time_s / capacity_as, drawn_soc)
    add_process_noise(s, p, q, w.throughput_as / capacity_as, bias_v2)


@njit(cache=True)
def apply_offdiagonal_transition(cov: Floats, f: Floats, by_offset: float, by_ln_q: float) -> None:
    """Apply the off-diagonal elements of F: derivatives of the SOC by offset [1/A] and by ln Q, and of the RC pairs by offset."""
    for k in range(STATES):
        cov[SOC, k] += by_offset * cov[OFFSET, k] + by_ln_q * cov[LN_Q, k]
        for j in range(X, X + BRANCHES):
            cov[j, k] -= (1.0 - f[j]) * cov[OFFSET, k]
    for k in range(STATES):
        cov[k, SOC] += by_offset * cov[k, OFFSET] + by_ln_q * cov[k, LN_Q]
        for j in range(X, X + BRANCHES):
            cov[k, j] -= (1.0 - f[j]) * cov[k, OFFSET]
    for j in range(SOC, X + BRANCHES):  # rounding makes the rows and columns differ
        for k in range(j):
            cov[j, k] = cov[k, j]
        for k in range(X + BRANCHES, STATES):
            cov[k, j] = cov[j, k]


@njit(cache=True)
def update(s: Record, p: Record, q: int, variance_v2: float) -> tuple[float, float, float]:
    """Update a hypothesis by the mean voltage of the window, linearized about the posterior SOC.

    At a knee of the OCV the secant over the prior SOC may be many times too steep (posterior linearization:
    Garcia-Fernandez et al., IEEE Trans. Signal Process. 63, 2015).

    Args:
        s: Record of EKF_STATE.
        p: Record of EKF_SETTINGS.
        q: Index of the hypothesis.
        variance_v2: R [V^2].

    Returns:
        Innovation [V], its variance S, and S without the linearization error of the OCV [V^2], all of the last iteration.
    """
    x, cov, ph = s.mean[q], s.covariance[q], s.ph
    soc, variance = x[SOC], cov[SOC, SOC]
    innovation_v, total_v2, linear_v2 = compute_innovation(s, p, q, variance_v2, soc, variance)
    for _ in range(MAX_ITERATIONS):
        posterior_soc = min(max(x[SOC] + ph[SOC] * innovation_v / total_v2, MIN_SOC), MAX_SOC)
        posterior_variance = cov[SOC, SOC] - ph[SOC] * ph[SOC] / total_v2
        change_of_reach = secant_reach(posterior_variance) - secant_reach(variance)
        if max(abs(posterior_soc - soc), abs(change_of_reach)) < CONVERGED_SOC:
            break
        soc, variance = posterior_soc, posterior_variance
        innovation_v, total_v2, linear_v2 = compute_innovation(s, p, q, variance_v2, soc, variance)
    apply_correction(x, cov, ph, innovation_v, total_v2, states_to_hold(s, p, q))
    x[LN_Q] = min(max(x[LN_Q], MIN_LN_Q), MAX_LN_Q)
    max_ln_r = MAX_STDS * resistance_std(s, p)
    for j in (LN_R0, LN_R):
        x[j] = min(max(x[j], -max_ln_r), max_ln_r)
    return innovation_v, total_v2, linear_v2


@njit(cache=True)
def compute_innovation(
    s: Record, p: Record, q: int, variance_v2: float, about_soc: float, about_variance: float
) -> tuple[float, float, float]:
    """Return the innovation, S, and S without the linearization error, linearized about an SOC. Write P H' to ``s.ph``."""
    cov, h, ph = s.covariance[q], s.h, s.ph
    predicted_v, nonlinear_v = linearise(s, p, q, about_soc, about_variance)
    innovation_v = s.window.sum_v / s.window.samples - predicted_v
    linear_v2 = variance_v2
    for j in range(STATES):
        ph[j] = 0.0
    for k in range(STATES):
        if h[k] != 0.0:  # it is 0 for all OCV nodes but two
            for j in range(STATES):
                ph[j] += cov[k, j] * h[k]
    for j in range(STATES):
        linear_v2 += h[j] * ph[j]
    min_v2 = (innovation_v / HUBER) ** 2
    return innovation_v, max(linear_v2 + nonlinear_v * nonlinear_v, min_v2), max(linear_v2, min_v2)


@njit(cache=True)
def secant_reach(variance: float) -> float:
    """Return half the SOC width of the OCV's secant for a variance of the SOC."""
    return min(max(math.sqrt(variance), MIN_REACH), MAX_REACH)


@njit(cache=True)
def linearise(s: Record, p: Record, q: int, about_soc: float, about_variance: float) -> tuple[float, float]:
    """Return the predicted mean voltage of the window and the linearization error of the OCV [V]; write H to ``s.h``.

    The model is linearized about ``about_soc`` over the width given by ``about_variance``, and evaluated at the filter's
    SOC.

    The model is (2.4) of the thesis with the ladder in place of two RC pairs:

        v = E_o(z, T) + M h + c e - e^s0 R_0 i - e^s sum R_k x_k + b_slow + b_fast

    M h is the hysteresis, and c e the varying error of the OCV (CURVE). s0 is LN_R0, and s is LN_R. H excludes the
    derivatives of the resistances and of the learned OCV by SOC, because errors of these would change the SOC.
    """
    x, h, ohm, w = s.mean[q], s.h, s.ohm, s.window
    soc = about_soc + (w.charge_as - w.sum_as / w.samples) / p.capacity_as  # in the middle of the samples
    resistances(soc, p.weak_ohm, p.strong_ohm, s.weak, s.strong, ohm)
    reach = secant_reach(about_variance)
    e_o, above, below = (
        ocv(soc, p.ocv_v, p.ocv_slope_v),
        ocv(soc + reach, p.ocv_v, p.ocv_slope_v),
        ocv(soc - reach, p.ocv_v, p.ocv_slope_v),
    )
    for j in range(STATES):
        h[j] = 0.0
    h[SOC] = max(0.5 * (above - below) / reach, MIN_SLOPE_V * p.series)
    r_0_factor, r_k_factor = math.exp(x[LN_R0]), math.exp(x[LN_R])
    h[LN_R0] = -r_0_factor * ohm[0] * (w.sum_a / w.samples - x[OFFSET])
    for k in range(BRANCHES):
        h[X + k] = -r_k_factor * ohm[1 + k]
        h[LN_R] += h[X + k] * (w.sum_x_a[k] / w.samples + x[X + k])
    h[OFFSET] = r_0_factor * ohm[0]
    h[B_SLOW] = h[B_FAST] = 1.0
    h[HYST] = s.hysteresis * on_grid(soc, p.hysteresis_v)
    h[CURVE] = on_grid(soc, p.varying_error_v)
    i, t = node_position(soc)
    node_v = node_error_scale(p, soc, t)
    h[NODE + i], h[NODE + i + 1] = (1.0 - t) * node_v, t * node_v
    voltage_v = e_o + h[HYST] * x[HYST] + h[CURVE] * x[CURVE] + h[LN_R0] + h[LN_R] + x[B_SLOW] + x[B_FAST]
    voltage_v += ocv_correction(p, x, soc) + (s.temperature_c - REFERENCE_C) * on_grid(soc, p.per_kelvin_v)
    voltage_v += h[SOC] * (x[SOC] - about_soc)
    return voltage_v, 0.5 * (above + below - 2.0 * e_o) * min(about_variance / (reach * reach), 1.0)


@njit(cache=True)
def update_state_directly(s: Record, p: Record, q: int, j: int, value: float, variance: float) -> None:
    """Update hypothesis ``q`` by a direct measurement of state ``j``."""
    x, cov, ph = s.mean[q], s.covariance[q], s.ph
    for k in range(STATES):
        ph[k] = cov[j, k]
    apply_correction(x, cov, ph, value - x[j], cov[j, j] + variance, cell_to_hold(s, p))


@njit(cache=True)
def states_to_hold(s: Record, p: Record, q: int) -> int:
    """Return the set of states that a voltage must not change.

    An SOC outside 0..1 is clipped, so that a voltage error there gives no information on sensor, capacity and curve. If the
    resistances are uncertain, resistance and capacity have equal effects on the voltage under a large constant current
    and in a constant-voltage charge. The capacity is then updated at rest, at small currents and in a varying discharge.
    """
    soc, one_c = s.mean[q, SOC], p.capacity_as / 3600.0
    if not 0.0 <= soc <= 1.0:
        is_charge = s.x_a[CHARGE_PAIR] < -CHARGE_C * one_c
        return HOLD_CELL | HOLD_OFFSET | (HOLD_CURVE if is_charge else 0)
    if p.r_std <= INDEPENDENT_R_STD:
        return cell_to_hold(s, p)
    small_a = NEARLY_FULL_C * one_c if soc > NEARLY_FULL_SOC else LEARNING_C * one_c
    varying = s.x_a[TREND_PAIR] > 0.0 and s.rms_a2 - s.mean_a * s.mean_a > (VARYING_C * one_c) ** 2
    capacity_is_visible = abs(s.x_a[TREND_PAIR]) < small_a or varying
    return cell_to_hold(s, p) | (0 if capacity_is_visible else HOLD_CAPACITY)


@njit(cache=True)
def cell_to_hold(s: Record, p: Record) -> int:
    """Return the set of the cell's states if the filter has learned them, and the empty set before."""
    return HOLD_CELL if s.learned_soc >= p.learning_soc else 0


@njit(cache=True)
def is_held(j: int, hold: int) -> bool:
    """Return True if state ``j`` is in the set ``hold``, so that its mean and variance do not change."""
    if j == LN_Q:
        return hold & HOLD_CAPACITY != 0
    if j == OFFSET:
        return hold & HOLD_OFFSET != 0
    if j == CURVE:
        return hold & HOLD_CURVE != 0
    return j >= NODE and hold & HOLD_NODES != 0


@njit(cache=True)
def apply_correction(x: Floats, cov: Floats, ph: Floats, innovation: float, variance: float, hold: int) -> None:
    """Correct state and P by an innovation e with variance S: x + P H' e / S, P - P H' H P / S.

    The gain of states in the set ``hold`` is 0 (Schmidt-Kalman filter). ``ph`` is P H' and is overwritten.
    """
    scale = 1.0 / math.sqrt(variance)
    for j in range(STATES):
        ph[j] *= scale
    for j in range(STATES):
        ph_j, row, held = ph[j], cov[j], is_held(j, hold)
        if not held:
            x[j] += ph_j * scale * innovation
        for k in range(STATES):
            if not (held and is_held(k, hold)):
                row[k] -= ph_j * ph[k]  # exactly symmetric in j and k
    x[SOC] = min(max(x[SOC], MIN_SOC), MAX_SOC)


@njit(cache=True)
def adapt_bias_inflation(s: Record, q: int, dt_s: float, u: float) -> None:
    """Adapt the inflation of the biases' variances to the mean innovation over one and over ten minutes.

    The running mean over a time T of a white, normalized innovation has the variance a / (2 - a) with a = dt / T for
    equidistant samples. Each inflation follows the ratio of the squared mean to that variance.

    Args:
        s: Record of EKF_STATE.
        q: Index of the hypothesis.
        dt_s: Step [s].
        u: Innovation over its std.
    """
    a, b = min(1.0, dt_s / MINUTE_S), min(1.0, dt_s / TEN_MINUTES_S)
    s.minute_u[q] += a * (u - s.minute_u[q])
    s.ten_minutes_u[q] += b * (u - s.ten_minutes_u[q])
    fast, slow = (2.0 - a) / a * s.minute_u[q] ** 2, (2.0 - b) / b * s.ten_minutes_u[q] ** 2
    s.fast_inflation[q] += min(1.0, dt_s / (INFLATION_AVERAGING[0] * MINUTE_S)) * (max(fast, 1.0) - s.fast_inflation[q])
    s.slow_inflation[q] += min(1.0, dt_s / (INFLATION_AVERAGING[1] * TEN_MINUTES_S)) * (
        max(slow, 1.0) - s.slow_inflation[q]
    )
